"""`python -m phd_exp.fusion`: compile the fusion for this machine, so that the first call does not wait for it."""

import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose, fuse
from phd_exp.fusion.tracks import ConstantVelocity, track


def main() -> None:
    """Fuse two predictions and smooth two frames, with covariances: that calls everything that is compiled."""
    predictions = ProjectedHuber.from_raw(torch.zeros(2, 7), f=1500.0, S=224.0, mu_z0=2.5e-3)
    here = Pose(torch.eye(3), torch.zeros(3))
    assert bool(fuse(predictions, here).covariance.isfinite().all())
    frames = predictions.expand((2, 2))
    assert bool(track(torch.arange(2.0), frames, here, ConstantVelocity(noise=1.0)).covariance.isfinite().all())


if __name__ == "__main__":
    main()
