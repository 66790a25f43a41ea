"""What `--help` prints, read from the files under conf/ and from the arguments of the verbs."""

import re
from collections.abc import Iterable, Iterator
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from phd_exp.cli import choices_of, conf_folder, prefix_of

VERBS = {
    "train": "render missing data, train, measure and record a run (the default)",
    "render": "render a data set, or its missing samples",
    "report": "the paper's tables, the dashboard and the figures of all recorded runs",
    "predict": "the object's position in an image and its uncertainty: JSON lines, and pictures with out=",
    "calibrate": "fit the uncertainty of a run to labelled images of yours, for predict calibration=NAME",
    "fuse": "one position from several cameras, or on a ground plane: one JSON line for each scene",
    "track": "the path of an object through a video or a folder: one JSON line for each frame; a video with out=",
    "search": "search for good values of keys with Optuna, judged on held-out samples",
    "pack": "write a run as one file to share, with a card: predict run=FILE",
    "export": "write a run's network as ONNX, compared with torch; the file needs only onnxruntime and NumPy",
}
OF_VERB = {
    "train": (
        *("model", "data", "preset", "recipe", "photometry", "experiment"),
        *("backbone", "camera", "loss", "optimizer", "trainer", "logger", "callbacks", "shift"),
    ),
    "render": ("data", "preset"),
}
"""The configuration groups that a verb uses; the other verbs use none."""
LINE = re.compile(r"( *)(\w+):(?: +([^#]*?))?(?: *# *(.*))?")
"""A line of YAML: indentation, key, value and comment."""
OF_DATA = {
    "data/default": "data: any rendered data set",
    "data/object": "data=object: further keys, and other defaults than above",
}
FILES = {
    "train": {
        "config": "",
        "trainer/auto": "trainer",
        "camera/known": "camera",
        "optimizer/adam": "optimizer=adam",
        "optimizer/muon": "optimizer=muon",
        "recipe/paper": "recipe=paper",
        **OF_DATA,
        "data/folder": "data=folder",
    },
    "render": {"render": "", **OF_DATA},
}
"""Verb -> the files of conf/ that explain its keys, with their headings."""
NAMES = {int: "int", float: "float", bool: "bool", NoneType: "null", tuple: "list", dict: "section"}
Key = tuple[str, str, str, str]
"""Name, type, default and description."""
COMPLETION = 'eval "$(phd-exp -sc install=bash)"'
EXAMPLES = {
    "train": [
        "python -m phd_exp model=mae_logz data=scale",
        "python -m phd_exp preset=small data=occl seed=1",
        "python -m phd_exp preset=small recipe=strong data=occl",
        "python -m phd_exp data.n_train=256 data.n_test=64 trainer.max_epochs=1",
        "python -m phd_exp data=object data.mesh=part.glb preset=small recipe=strong",
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
        "python -m phd_exp render data=occl masks=masks/occl bop=bop/occl",
    ],
    "report": ["python -m phd_exp report", "python -m phd_exp report runs=some/folder out=another"],
    "predict": [
        "python -m phd_exp predict run=DIR image=photo.jpg f=1550 box=400,30,620,140",
        "python -m phd_exp predict run=DIR image=a.jpg fx=900 fy=900 cx=320 cy=240 box=400,30,620,140 out=pictures",
        "python -m phd_exp predict run=DIR folder=photos camera=camera.yaml boxes=mydetector:find out=pictures",
        "python -m phd_exp predict run=DIR folder=photos/test recalibrate=true > predictions.jsonl",
        "python -m phd_exp predict run=runs/small/default/probabilistic folder=photos/test",
        "python -m phd_exp predict run=DIR,DIR,DIR views=8 folder=photos/test",
        "python -m phd_exp predict run=DIR folder=drive.mcap box=400,30,620,140 out=found.mcap",
        "python -m phd_exp predict run=DIR folder=photos/test view=photos.rrd",
    ],
    "calibrate": [
        "python -m phd_exp calibrate run=DIR folder=photos/labelled",
        "python -m phd_exp predict run=DIR calibration=photographs folder=photos/new",
    ],
    "fuse": [
        "python -m phd_exp fuse run=runs/small/scale/probabilistic/seed0 folder=renders/multiview/test",
        "python -m phd_exp fuse run=DIR folder=photos/test plane=0,1,0,1.5 recalibrate=true out=fused.jsonl",
    ],
    "track": [
        "python -m phd_exp track run=DIR video=clip.mp4 camera=camera.yaml box=400,30,620,140 out=tracked",
        "python -m phd_exp track run=DIR video=clip.mp4 f=900 boxes=mydetector:find",
        "python -m phd_exp track run=DIR video=clip.mp4 f=900 boxes=detections.json",
        "python -m phd_exp track run=DIR folder=frames > track.jsonl",
    ],
    "search": [
        "python -m phd_exp search space.yaml trials=40",
        "python -m phd_exp search space.yaml trials=40 preset=small data=occl",
    ],
    "pack": [
        "python -m phd_exp pack run=DIR out=run.zip license=CC-BY-4.0",
        "python -m phd_exp predict run=run.zip image=photo.jpg f=1550 box=400,30,620,140",
    ],
    "export": [
        "python -m phd_exp export run=runs/small/default/probabilistic/seed0",
        "python -m phd_exp export run=DIR out=network.onnx photographs=true",
    ],
}


def text_of(verb: str | None) -> str:
    """The help of one verb, or of the programme."""
    if verb is None:
        return _PROGRAMME.format(
            verbs="\n".join(f"  {name:<9} {purpose}" for name, purpose in VERBS.items()),
            groups=_choices(OF_VERB["train"]),
            conf=conf_folder(),
            examples="\n".join(f"  {lines[0]}" for lines in EXAMPLES.values()),
            completion=COMPLETION,
        )
    words, groups = "SPACE.yaml [key=value ...]" if verb == "search" else "[key=value ...]", ""
    if verb in OF_VERB:
        words, groups = f"[-m] [group=choice ...] {words}", f"\n\ngroups\n{_choices(OF_VERB[verb])}"
    keys = "".join(
        f"\n{heading}".rstrip()
        + "".join(f"\n  {key}  {kind}, {value}\n      {text}" for key, kind, value, text in keys)
        for heading, keys in keys_of(verb).items()
    )
    examples = "".join(f"\n  {line}" for line in EXAMPLES[verb])
    usage = f"usage: python -m phd_exp {verb} {words}\n\n{VERBS[verb]}"
    return f"{usage}{groups}\n\nkeys: type, default{keys}\n\nexamples{examples}"


def keys_of(verb: str) -> dict[str, list[Key]]:
    """Heading -> the keys of a verb, except the arguments of most classes that its groups choose."""
    if verb in FILES:
        return {heading: list(_in_file(file, verb)) for file, heading in FILES[verb].items()}
    fields = getattr(import_module(f"phd_exp.cli.{verb}"), f"{verb.title()}Arguments").model_fields
    found = []
    for name, field in fields.items():
        default = "required" if field.is_required() else str(field.default).lower().replace("none", "null")
        found.append((name, _type(field.annotation), default, " ".join((field.description or "").split())))
    return {"": found}


def _in_file(file: str, verb: str) -> Iterator[Key]:
    """The keys in a file of conf/ that have a comment."""
    from phd_exp.config import RenderConfig, RunConfig  # pydantic, which the help of the programme does without

    content = (conf_folder() / f"{file}.yaml").read_text()
    group = file.rpartition("/")[0]
    prefix, types = prefix_of(group, content), _types(RunConfig if verb == "train" else RenderConfig)
    of_presets = (conf_folder() / "preset/paper.yaml").read_text()
    sections: list[str] = []
    for text in content.splitlines():
        if not (found := LINE.fullmatch(text)):
            continue
        depth = len(found[1]) // 2
        sections = [*sections[:depth], found[2]]
        name, value, comment = prefix + ".".join(sections), found[3], found[4]
        kind = types.get(name)
        if group == "optimizer":  # its class has no model
            kind = "bool" if value == "true" else "float"
        if value and comment and kind:
            unset = "set by preset" if f"{found[2]}:" in of_presets else "required"
            yield name, kind, {"???": unset, "{}": "empty"}.get(value, value), comment


def _types(annotation: Any, name: str = "") -> dict[str, str]:
    """Dotted key below a model -> its type."""
    from phd_exp.records.errors import keys_of_section

    found = {name: _type(annotation)}
    if hasattr(annotation, "model_fields"):
        for key, part in keys_of_section(annotation).items():
            found |= _types(part, f"{name}.{key}".lstrip("."))
    for part in get_args(annotation):
        if not isinstance(part, str):
            found |= {key: kind for key, kind in _types(part, name).items() if key != name}
    return found


def _type(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(parts[0])
    if origin is Literal:
        return "|".join(map(str, parts))
    if origin in (Union, UnionType):
        return " or ".join(map(_type, parts))
    return NAMES.get(origin or annotation, "text")


def _choices(groups: Iterable[str]) -> str:
    """The choices of each group, a line a group."""
    return "\n".join(f"  {group:<10} {', '.join(choices_of(group))}" for group in groups)


_PROGRAMME = """\
usage: python -m phd_exp [verb] [-m] [group=choice ...] [key=value ...]

Probabilistic 3-D position estimation from a single camera, with uncertainty you can trust.

verbs
{verbs}

groups (conf/config.yaml names the default of each)
{groups}

-m runs every combination of comma-separated values, or of an experiment. The same command again skips finished
runs and resumes the others. The files of {conf} explain every key;
`python -m phd_exp --cfg job` prints the whole configuration.

cost: the default preset=paper renders 11,000 images and trains ResNet-50 on 8,000 of them for 50 epochs, which
takes a GPU or many hours. preset=small takes ten minutes on two cores. A run first prints its work, and the time
left after its first batches.

examples
{examples}

`python -m phd_exp <verb> --help` explains a verb. An installed `phd-exp` is the same programme; after
{completion} the TAB key completes its words."""
