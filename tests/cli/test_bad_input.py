"""What a user may get wrong: one clear line that names it, a non-zero exit, nothing written."""

from collections.abc import Callable
from pathlib import Path

import pytest

BAD = [
    # (arguments, what the line must say)
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
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=lambda value: " ".join(value)[:40])
def test_one_clear_line(phd_exp: Callable, tmp_path: Path, arguments: list[str], said: list[str]) -> None:
    outcome = phd_exp("preset=smoke", "logger=none", *arguments)
    lines = outcome.err.strip().splitlines()
    assert outcome.status == 2
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("error: ")
    for word in said:
        assert word in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_own_images_are_not_rendered(phd_exp: Callable, tmp_path: Path) -> None:
    for arguments in (["data=folder"], ["data=folder", "data.folder=photos"]):
        outcome = phd_exp("render", *arguments)
        assert outcome.status == 2
        (line,) = outcome.err.splitlines()
        assert "data=folder: there is nothing to render, these are your own images" in line
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_metadata(phd_exp: Callable, tmp_path: Path) -> None:
    outcome = phd_exp("preset=smoke", "logger=none", "data=folder", "data.folder=photos")
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: photos/train/metadata.jsonl: cannot be read (No such file")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("shard=4/4", "shard: got '4/4'; expected INDEX/COUNT with 0 <= INDEX < COUNT, from 0/4 to 3/4"),
        ("shard=-1/2", "shard: got '-1/2'; expected INDEX/COUNT"),
        ("shard=1/0", "shard: got '1/0'; expected INDEX/COUNT"),
        ("shard=a", "shard: got 'a'; expected INDEX/COUNT"),
        ("shard=2", "shard: got 2; expected INDEX/COUNT"),
        ("shrad=0/2", "shrad: unknown key, did you mean 'shard'?; see `python -m phd_exp render --cfg job`"),
        ("+shards=0/2", "shards: unknown key"),
        ("data.workers=0", "data.workers: got 0"),
    ],
)
def test_render_says_in_one_line_what_is_wrong(
    phd_exp: Callable, tmp_path: Path, argument: str, said: str
) -> None:
    outcome = phd_exp("render", "preset=smoke", argument)
    assert outcome.status == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {said}")
    assert list(tmp_path.iterdir()) == []


def test_rendering_has_keys_that_a_run_has_not(phd_exp: Callable) -> None:
    assert "shard: null" in phd_exp("render", "--cfg", "job").out
    assert "shard: unknown key" in phd_exp("train", "preset=smoke", "shard=0/2").err


def test_an_unwritable_folder_of_a_sweep(phd_exp: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    outcome = phd_exp("-m", "preset=smoke", "seed=0,1", "runs=file/runs")
    assert outcome.status == 1
    assert (
        outcome.err == "error: file/runs/.sweep: Not a directory; mend that, and the same command resumes\n"
    )


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
