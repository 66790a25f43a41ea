"""The pinhole camera, virtual cameras, the charts in which positions are regressed; and this project's symbols.

Frames. The camera frame has x to the right, y down and z forward along the optical axis, in metres. Pixels count
from the top left corner of the image; the centre of the pixel in column c and row r lies at (c + 0.5, r + 0.5).

| symbol | name in code | meaning | unit | defined in |
|---|---|---|---|---|
| v = (x, y, z) | `xyz` | position in the camera frame | metres | `geometry.camera.Camera` |
| f | `f` | focal length | pixels | `geometry.camera.Camera` |
| S | `S` | side of the square image; the principal point is (S/2, S/2) | pixels | `geometry.camera.Camera` |
| K, R | `K`, `R` | intrinsics of a real camera, and the rotation from its frame to that of a virtual one | - | `optics.virtual.VirtualCamera` |
| v_p | `v_p` | projected position 2 f (x, y) / (S z), in [-1, 1] inside the image | - | `geometry.charts.projected` |
| z_p | `z_p` | depth z / (mu_z0 f) after compensation for the focal length, in [1/D, D] | - | `geometry.charts.compensated_depth` |
| mu_z0 | `mu_z0` | the data set's typical depth per focal length, sqrt(max(z/f) min(z/f)) | metres per pixel | `geometry.charts.DepthScale` |
| D | `D` | the data set's depth range, sqrt(max(z/f) / min(z/f)) | - | `geometry.charts.DepthScale` |
| mu_xy | `mu_xy` | centre of (x, y)/z | - | `distributions.projected_huber.ProjectedHuber` |
| mu_z | `mu_z` | centre of z: its mode, and the mode of the whole density is mu_z (mu_xy, 1) | metres | `distributions.projected_huber.ProjectedHuber` |
| A | `A` | precision of (x, y)/z, symmetric positive definite 2 x 2 | - | `distributions.projected_huber.ProjectedHuber` |
| a | `a` | precision of z: E[(z - mu_z)^2] is about 2 mu_z^2 / a^2 where a is large and r = 0 | - | `distributions.projected_huber.ProjectedHuber` |
| k | `k` | free axis: q has the further term k a (t - 1); none in the paper's density | - | `distributions.projected_huber.ProjectedHuber` |
| r | `rounding` | how far the mode of depth is rounded, in units of mu_z/a; 0 in the paper's density | - | `distributions.rounded.Rounded` |
| m_xy | `m_xy` | slope of the axis, the change of the centre of (x, y) with z: mu_xy without a free axis | - | `distributions.projected_huber.ProjectedHuber.m_xy` |
| nu_p, B | `nu_p`, `B` | centre and precision of v_p in the frame of the network: B v_p - nu_p | - | `distributions.natural.Natural.from_raw` |
| nu_z | `nu_z` | mu_z / (mu_z0 f), the centre of z_p | - | `distributions.natural.Natural.from_raw` |
| A_xy | `A_xy` | A / mu_z, precision of (x, y) at any depth | 1 / metres | `distributions.natural.Natural` |
| nu_xy | `nu_xy` | A_xy mu_xy | 1 / metres | `distributions.natural.Natural` |
| q | `q` | the whitened projection A_xy (x, y) - nu_xy z + k a (t - 1), independent of t | - | `distributions.projected_huber.ProjectedHuber.whiten` |
| t | `t` | the relative depth z / mu_z | - | `distributions.kinked` |
| h | `huber_energy` | Huber's function: r^2/2 up to 1, r - 1/2 beyond | - | `distributions.huber.huber_energy` |
| E_n | `scaled_expint` | generalised exponential integral E_n(a) = int_1^inf e^(-a u) u^(-n) du | - | `distributions.special.scaled_expint` |
| N | `log_normaliser` | normaliser of the depth law, e^(-a)/a + E_2(a) | - | `distributions.special.log_normaliser` |
| g | `tail_moment(0, a)` | a e^a E_2(a), in (0, 1): the odds of t < 1 | - | `distributions.special.tail_moment` |
| u | `u` | unknowns of a fusion: the position itself, or its place on a plane | metres | `fusion.problems` |
| lam | `lam` | subgradient of max(t, 1/t) at its kink t = 1, in [-1, 1] | - | `fusion.newton.subgradient` |
| 7 outputs | `raw` | (n_1, n_2, b_1, b_2, b_3, w_1, w_2): what a network returns; with a free axis also k_1, k_2 | - | `models.heads.DistributionHead` |
"""

from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import Cartesian, Chart, DepthScale, LogDepth, Projected, compensated_depth, projected
from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import VirtualCamera, intrinsics

__all__ = [
    "Camera",
    "Cartesian",
    "Chart",
    "DepthScale",
    "Lens",
    "LogDepth",
    "Projected",
    "VirtualCamera",
    "compensated_depth",
    "intrinsics",
    "projected",
]
