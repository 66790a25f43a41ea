"""The common type of all densities that a head may predict."""


class Density:
    """A density over positions v = (x, y, z) in the camera frame, metres, for each element of a batch.

    Training, records and reports use `log_prob`, `level` and `rsample`; the properties `mode`, `mean`, `mu_xy` and
    `projected_covariance` (of (x, y)/z), `depth_mean`, `depth_variance` and `depth_median`; `depth_cdf` and
    `depth_crps`. `ProjectedHuber` documents their meaning. `shaped.Shaped` derives most of them from a few.
    """
