"""Multi-view and ground-plane fusion: the most likely position under several predictions, as a convex problem.

`newton.py` solves a smoothed problem, `polish.py` makes it exact, `certificate.py` proves how good that is without
trusting either, `moments.py` adds mean and covariance, `fuse.py` puts them together.
"""

from phd_exp.fusion.fuse import fuse
from phd_exp.fusion.fused import Fused
from phd_exp.fusion.gaussian import average, gaussian_fusion
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.status import FusionError, Status

__all__ = ["Fused", "FusionError", "Plane", "Pose", "Status", "average", "fuse", "gaussian_fusion"]
