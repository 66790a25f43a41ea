"""`python -m phd_exp.fusion`: compile the fusion for this machine, so that the first call does not wait for it."""

import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose, fuse


def main() -> None:
    """Fuse two predictions and compute their covariance: that calls everything that is compiled."""
    predictions = ProjectedHuber.from_raw(torch.zeros(2, 7), f=1500.0, S=224.0, mu_z0=2.5e-3)
    here = Pose(torch.eye(3), torch.zeros(3))
    assert bool(fuse(predictions, here).covariance.isfinite().all())


if __name__ == "__main__":
    main()
