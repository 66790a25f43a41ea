"""How many cores a job may use, where several run at once on one machine."""

from collections.abc import Mapping
from typing import Any

from phd_exp.records.provenance import usable_cores


def cores_a_job(launcher: Mapping[str, Any], jobs: int) -> int | None:
    """The share of each job where a launcher runs several at once on this machine, at least one core.

    None where a job has for itself all that its process may use: with Hydra's basic launcher, in a queue.

    Args:
        launcher: its section of the configuration.
        jobs: how many there are to run.
    """
    match str(launcher["_target_"]).rpartition(".")[2]:
        case "JoblibLauncher":
            return _share(min(jobs, _joblib_processes(launcher["n_jobs"])))
        case "LocalLauncher":  # submitit without a queue begins all jobs at once
            return _share(jobs)
        case "RayLauncher":  # begins as many jobs as their cores allow; one each unless told otherwise
            return int(launcher["ray"]["remote"].get("num_cpus") or 1)
    return None


def _share(jobs_at_once: int) -> int:
    return max(1, usable_cores() // jobs_at_once)


def _joblib_processes(n_jobs: int) -> int:
    """As joblib counts: -1 stands for all cores, -2 for all but one."""
    return n_jobs if n_jobs > 0 else max(1, usable_cores() + 1 + n_jobs)
