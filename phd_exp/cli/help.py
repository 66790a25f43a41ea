"""What `--help` prints: read from the files under conf/, so that it cannot fall behind them."""

from collections.abc import Iterable

from phd_exp.cli.paths import conf_folder

VERBS = {
    "train": "render what is missing, train, measure and record a run (the default)",
    "render": "render a data set, or what is missing of it",
    "report": "the paper's tables, the dashboard and the figures of all recorded runs",
    "predict": "where the object in an image is and how sure a run is of it: JSON lines, and pictures with out=",
    "fuse": "one position from the predictions of several cameras, and/or on a ground plane: a JSON line a scene",
    "export": "write a run's network as ONNX, checked against torch; decoding it needs NumPy and SciPy alone",
}
OF_VERB = {
    "train": (
        *("model", "data", "preset", "recipe", "without", "experiment"),
        *("backbone", "camera", "loss", "optimizer", "trainer", "logger"),
    ),
    "render": ("data", "preset"),
    "report": (),
    "predict": (),
    "fuse": (),
    "export": (),
}
"""The groups whose choice a verb looks at."""
COMPLETION = 'eval "$(phd-exp -sc install=bash)"'
EXAMPLES = {
    "train": [
        "python -m phd_exp model=mae_logz data=scale",
        "python -m phd_exp preset=small data=occl seed=1",
        "python -m phd_exp preset=small recipe=strong data=occl",
        "python -m phd_exp data.n_train=256 data.n_test=64 trainer.max_epochs=1",
        "python -m phd_exp data=folder data.folder=photos preset=small",
        "python -m phd_exp -m preset=small model=probabilistic,mae_vz data=default,occl",
        "python -m phd_exp -m experiment=table1,table2 preset=small seed=0,1,2",
        "python -m phd_exp -m experiment=table2 preset=small hydra/launcher=joblib hydra.launcher.n_jobs=2",
        "python -m phd_exp trainer=ddp trainer.devices=2",
    ],
    "render": [
        "python -m phd_exp render data=scale",
        "python -m phd_exp render data=occl data.n_train=100 data.n_test=20 data.workers=1",
        "python -m phd_exp -m render data=scale data.workers=1 shard=0/4,1/4,2/4,3/4 hydra/launcher=joblib",
        "python -m phd_exp render data=scale verify=true",
        "python -m phd_exp render data=occl masks=masks/occl",
    ],
    "report": ["python -m phd_exp report", "python -m phd_exp report runs=some/folder out=another"],
    "predict": [
        "python -m phd_exp predict run=runs/small/default/probabilistic/seed0 image=photo.jpg f=1550",
        "python -m phd_exp predict run=DIR image=a.jpg fx=900 fy=900 cx=320 cy=240 box=400,30,620,140 out=pictures",
        "python -m phd_exp predict run=DIR folder=photos/test recalibrate=true > predictions.jsonl",
    ],
    "fuse": [
        "python -m phd_exp fuse run=runs/small/scale/probabilistic/seed0 folder=renders/multiview/test",
        "python -m phd_exp fuse run=DIR folder=photos/test plane=0,1,0,1.5 recalibrate=true out=fused.jsonl",
    ],
    "export": [
        "python -m phd_exp export run=runs/small/default/probabilistic/seed0",
        "python -m phd_exp export run=DIR out=network.onnx",
    ],
}


def show(verb: str | None) -> int:
    """Print the help of one verb, or of the programme; returns the exit status."""
    if verb is not None and verb not in VERBS:
        print(f"no verb {verb!r}; there are {', '.join(VERBS)}")
        return 2
    print(_verb_help(verb) if verb else _programme_help())
    return 0


def _programme_help() -> str:
    verbs = [f"  {name:<8} {purpose}" for name, purpose in VERBS.items()]
    examples = [f"  {lines[0]}" for lines in EXAMPLES.values()]
    return "\n".join(
        [
            "usage: python -m phd_exp [verb] [-m] [group=choice ...] [key=value ...]",
            "",
            "Probabilistic 3-D position estimation from a single camera, with uncertainty you can trust.",
            "",
            "verbs",
            *verbs,
            "",
            "groups (the first choice of a run is named in conf/config.yaml)",
            *_groups(OF_VERB["train"]),
            "",
            "-m runs every combination of values given with commas, or of an experiment; the same command again",
            "skips what is finished and goes on with the rest. Every key is explained in the files of",
            f"{conf_folder()}; `python -m phd_exp --cfg job` prints the whole configuration.",
            "",
            "cost: the default preset=paper renders 11,000 images and trains ResNet-50 for 50 epochs on 8000 of",
            "them, which takes a GPU or many hours. preset=small takes ten minutes on two cores.",
            "A run prints what it is going to do, and the time left once its first batches are timed.",
            "",
            "examples",
            *examples,
            "",
            "python -m phd_exp <verb> --help tells more. An installed phd-exp is the same programme; the TAB key",
            f"completes its words after {COMPLETION}.",
        ]
    )


def _verb_help(verb: str) -> str:
    groups = ["", "groups", *_groups(OF_VERB[verb])] if OF_VERB[verb] else []
    words = "[-m] [group=choice ...] [key=value ...]" if groups else "[key=value ...]"
    return "\n".join(
        [
            f"usage: python -m phd_exp {verb} {words}",
            "",
            VERBS[verb],
            *groups,
            "",
            "examples",
            *(f"  {line}" for line in EXAMPLES[verb]),
        ]
    )


def _groups(names: Iterable[str]) -> list[str]:
    return [f"  {name:<10} {', '.join(_choices(name))}" for name in names]


def _choices(group: str) -> list[str]:
    return sorted(file.stem for file in (conf_folder() / group).glob("*.yaml"))
