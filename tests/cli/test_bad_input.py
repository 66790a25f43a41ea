"""Each user error gives one clear line and a non-zero exit status, and nothing is written."""

from collections.abc import Callable
from pathlib import Path

import pytest

NOTHING_TO_RENDER = "there is nothing to render, these are your own images"
BAD = [
    # (arguments, parts of the line)
    (["data.ntrain=3"], ["data.ntrain: unknown key, did you mean 'n_train'?; expected one of n_train, "]),
    (["trainer.fast_dev_run=1"], ["trainer.fast_dev_run: unknown key; expected one of max_epochs, accel"]),
    (["modle=mae_vz"], ["modle", "did you mean 'model'"]),
    (["model=mae_log"], ["model=mae_log", "did you mean 'mae_logz'", "probabilistic"]),
    (["data=scal"], ["data=scal", "did you mean 'scale'"]),
    (["+model.typo=1"], ["model.typo", "unknown key", "expected one of name, head"]),
    (["+data.n_trian=1"], ["data.n_trian", "did you mean 'n_train'"]),
    (["+typo=1"], ["typo", "unknown key"]),
    (["+optimizer.lrr=1"], ["optimizer.lrr", "did you mean 'lr'", "torch.optim.Adam"]),
    (["+model.head.depht=1"], ["model.head.depht", "unknown key"]),
    (["data.n_train=abc"], ["data.n_train", "'abc'", "integer"]),
    (["data.n_train=2.5"], ["data.n_train", "2.5", "integer"]),
    (["data.n_train=true"], ["data.n_train", "True", "integer"]),
    (["optimizer.lr=fast"], ["optimizer.lr", "'fast'", "number"]),
    (["backbone.depth=19"], ["backbone.depth", "19", "18, 34 or 50"]),
    (["trainer.precision=half"], ["trainer.precision", "'half'", "'bfloat16'"]),
    (["data.n_train=0"], ["data.n_train", "got 0", "greater than or equal to 1"]),
    (["data.n_test=-1"], ["data.n_test", "got -1"]),
    (["data.f_range=[0,2000]"], ["data.f_range", "got 0", "greater than or equal to 10"]),
    (["data.f_range=[-1200,2000]"], ["data.f_range", "got -1200"]),
    (["data.f_range=[2000,1200]"], ["data.f_range", "lower bound"]),
    (["data.z_range=[0,5]"], ["data.z_range"]),
    (["data.image_size=7"], ["data.image_size", "got 7", "greater than or equal to 32"]),
    (["data.image_size=448"], ["data", "image_size=448", "sensor_size=224"]),
    (["data.batch_size=64"], ["data", "batch_size=64", "n_train=32"]),
    (["data.xy_range=2"], ["data.xy_range"]),
    (["data.variant=../elsewhere"], ["data.variant"]),
    (["seed=-1"], ["seed", "got -1"]),
    (["trainer.max_epochs=0"], ["trainer.max_epochs", "got 0"]),
    (["trainer.threads=0"], ["trainer.threads", "got 0"]),
    (["evaluation.calibration_window=0"], ["evaluation.calibration_window"]),
    (["evaluation.every_n_epochs=3"], ["evaluation", "calibration_every_n_epochs=10 is no multiple"]),
    (["evaluation.multiview.scenes=-1"], ["evaluation.multiview.scenes", "got -1"]),
    (["evaluation.multiview.views=1"], ["evaluation.multiview.views", "got 1"]),
    (["evaluation.multiview.angle_range=[60,20]"], ["evaluation.multiview.angle_range", "lower bound"]),
    (["evaluation.multiview.scenes=9", "data=occl"], ["evaluation.multiview.scenes", "expected data=scale"]),
    (
        ["evaluation.multiview.scenes=9", "data=folder", "data.folder=photos"],
        ["not of data=", "expected data=scale"],
    ),
    (
        ["evaluation.multiview.scenes=9", "data=scale", "model=mae_vz"],
        ["model=mae_vz predicts points", "expected model=probabilistic"],
    ),
    (["loss=mae"], ["loss", "PointEstimate", "model=probabilistic", "ProjectedHuber"]),
    (["model=mae_vz", "loss=nll"], ["loss", "ProjectedHuber", "model=mae_vz"]),
    (["loss._target_=os.system"], ["loss._target_", "os.system", "phd_exp."]),
    (["loss._target_=phd_exp.losses.nll.Nothing"], ["loss._target_", "does not exist"]),
    (["data.n_train=["], ["viable"]),
    (["optimizer.lr=-1"], ["optimizer: ", "learning rate", "-1"]),
    (["+optimizer.betas=[0.9,1.5]"], ["optimizer: ", "beta", "1.5"]),
    (["optimizer._target_=torch.optim.Nadam"], ["optimizer._target_", "does not exist"]),
    (["data=folder"], ["data.folder: missing", "data.folder=VALUE"]),
    (["data.folder=photos"], ["data.folder", "not a key of this choice", "data=folder"]),
    (["+data.folder=photos"], ["data.folder: unknown key", "expected one of", "sensor_size"]),
    (["data=folder", "data.folder=photos", "+data.variant=x"], ["data.variant: unknown key", "name, folder"]),
    (["data=folder", "data.folder=photos", "+data.n_trian=1"], ["data.n_trian", "did you mean 'n_train'"]),
    (["data=folder", "data.folder=photos", "data.n_train=2.5"], ["data.n_train", "2.5", "integer"]),
    (["data=folder", "data.folder=photos", "data.n_train=3"], ["data", "batch_size=16", "n_train=3"]),
    (["data=folder", "data.folder=photos", "data.name=../x"], ["data.name", "'../x'"]),
    (["optimizer._target_=torch.optim.SGD", "+optimizer.momentum=-1"], ["optimizer: ", "momentum"]),
    (["render", "data=folder"], [f"data=folder: {NOTHING_TO_RENDER}"]),
    (["render", "data=folder", "data.folder=photos"], [f"data=folder: {NOTHING_TO_RENDER}"]),
    (["render", "shard=4/4"], ["shard: got '4/4'; expected INDEX/COUNT with 0 <= INDEX < COUNT, from 0/4 to 3/4"]),
    (["render", "shard=-1/2"], ["shard: got '-1/2'; expected INDEX/COUNT"]),
    (["render", "shard=1/0"], ["shard: got '1/0'; expected INDEX/COUNT"]),
    (["render", "shard=a"], ["shard: got 'a'; expected INDEX/COUNT"]),
    (["render", "shard=2"], ["shard: got 2; expected INDEX/COUNT"]),
    (["render", "shrad=0/2"], ["shrad: unknown key, did you mean 'shard'?", "`python -m phd_exp render --cfg job`"]),
    (["render", "+shards=0/2"], ["shards: unknown key"]),
    (["train", "shard=0/2"], ["shard: unknown key"]),
    (["render", "data.workers=0"], ["data.workers: got 0"]),
    (["render", "verify=perhaps"], ["verify: got 'perhaps'"]),
    (["render", "rerender=-1"], ["rerender: got -1"]),
    (["render", "masks=true"], ["masks: got True; expected the name of a folder"]),
    (["render", "data.image_format=gif"], ["data.image_format: got 'gif'"]),
    (["render", "data.image_quality=0"], ["data.image_quality: got 0"]),
    (["render", "data.views=0"], ["data.views: got 0"]),
    (["render", "data.view_angle_range=[60,20]"], ["data.view_angle_range: "]),
    (["experiment=table1"], ["experiment=table1: names several runs; write -m before it: -m experiment=table1"]),
    (["-m", "experiment=tabel1"], ["experiment=tabel1: no such choice, did you mean 'table1'?"]),
    (["-m", "experiment=table1,tabel2"], ["experiment=tabel2: no such choice, did you mean 'table2'?"]),
    (["-m", "experiment=glob(nothing*)"], ["experiment=glob(nothing*)", "not one combination"]),
    (["-m", "experiment=null", "seed=0,1"], ["Config group override must be a string or a list. Got NoneType"]),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "parts"), BAD, ids=lambda value: " ".join(value)[:40])
def test_a_wrong_configuration_is_one_line(
    phd_exp: Callable, tmp_path: Path, arguments: list[str], parts: list[str]
) -> None:
    outcome = phd_exp(*arguments, "preset=smoke", "logger=none")
    (line,) = outcome.err.splitlines()
    assert (outcome.status, line[:7]) == (2, "error: ")
    assert all(part in line for part in parts), line
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_metadata(phd_exp: Callable, tmp_path: Path) -> None:
    outcome = phd_exp("preset=smoke", "logger=none", "data=folder", "data.folder=photos")
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: photos/train/metadata.jsonl: cannot be read (No such file")
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_folder_of_a_sweep(phd_exp: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    outcome = phd_exp("-m", "preset=smoke", "seed=0,1", "runs=file/runs")
    assert outcome.status == 1
    assert outcome.err == "error: file/runs/.sweep: Not a directory; mend that, and the same command resumes\n"


def test_wandb_without_a_key_is_refused_before_anything_is_rendered(
    phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    outcome = phd_exp("preset=smoke", "logger.offline=false")
    assert outcome.status == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: logger.offline: got false, but wandb has no API key")
    assert list(tmp_path.iterdir()) == []


def test_each_thing_wrong_gets_its_own_line(phd_exp: Callable) -> None:
    outcome = phd_exp("preset=smoke", "seed=-1", "data.n_test=0")
    assert outcome.err.splitlines() == [
        "error: seed: got -1; expected to be greater than or equal to 0",
        "error: data.n_test: got 0; expected to be greater than or equal to 1",
    ]


def test_unknown_verb(phd_exp: Callable) -> None:
    outcome = phd_exp("trian")
    assert outcome.status == 2
    assert "no verb 'trian'" in outcome.err
    assert "train, render, report" in outcome.err


def test_report_without_runs(phd_exp: Callable) -> None:
    outcome = phd_exp("report")
    assert outcome.status == 1
    assert outcome.err == "error: runs: no such folder; train first, or name another by runs=DIR\n"


def test_unwritable_folder(phd_exp: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    outcome = phd_exp("preset=smoke", "logger=none", "data.root=file/renders")
    assert outcome.status == 1
    assert len(outcome.err.splitlines()) == 1
    assert "file/renders" in outcome.err
    assert {path.name for path in tmp_path.iterdir()} == {"file"}
