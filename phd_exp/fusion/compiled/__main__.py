"""`python -m phd_exp.fusion.compiled`: compile everything for this machine, so that no first call waits for it."""

import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose, fuse


def main() -> None:
    """Fuse a single prediction, and take its covariance: that reaches all that is compiled."""
    prediction = ProjectedHuber.from_raw(torch.zeros(1, 7), f=torch.tensor(1500.0), S=224.0, mu_z0=2.5e-3)
    here = Pose(torch.eye(3), torch.zeros(3))
    assert bool(fuse(prediction, here).covariance.isfinite().all())


if __name__ == "__main__":
    main()
