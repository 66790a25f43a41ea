"""Fusion of several cameras, and of a ground plane: the most likely position is the solution of a convex problem.

`newton.py` solves a smoothed problem, `polish.py` makes the solution exact, `certificate.py` bounds its error without
trusting either, `moments.py` adds mean and covariance. All four are compiled for one problem of a few cameras, which
fits into the cache of a core; `kernels.py` runs them on a batch, `fuse.py` is the interface.
"""

from phd_exp.fusion.fuse import Fused, FusionError, fuse
from phd_exp.fusion.gaussian import average, gaussian_fusion
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.problems import Status

__all__ = ["Fused", "FusionError", "Plane", "Pose", "Status", "average", "fuse", "gaussian_fusion"]
