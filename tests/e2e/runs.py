"""Runs as the tests of whole commands look at them."""

from pathlib import Path

import torch

from phd_exp.records.runs import RunFolder, find_runs


def only_run(runs: Path) -> RunFolder:
    """The one run that is recorded there."""
    (run,) = find_runs(runs)
    return run


def weights(run: RunFolder) -> dict[str, torch.Tensor]:
    """The network's weights in its last checkpoint."""
    state = torch.load(run.last_checkpoint, weights_only=True)["state_dict"]
    return {name: weight for name, weight in state.items() if name.startswith("regressor.")}
