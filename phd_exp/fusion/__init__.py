"""Fusion of several cameras, and of a ground plane: the most likely position is the solution of a convex problem.

`newton.py` finds the optimum, and `moments.py` adds mean and covariance. Both are compiled for one problem of a few
cameras, which fits into the cache of a core; `kernels.py` runs them on a batch, and `fuse.py` is the interface.
"""

from phd_exp.fusion.fuse import Fused, fuse
from phd_exp.fusion.gaussian import average, gaussian_fusion
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.shared import fuse_shared
from phd_exp.fusion.views import Status

__all__ = ["Fused", "Plane", "Pose", "Status", "average", "fuse", "fuse_shared", "gaussian_fusion"]
