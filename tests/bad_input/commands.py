"""Every named mistake on the command line: in configurations, and in the arguments of the other verbs."""

import json
import re
from typing import Any

from tests.bad_input.bad import EXPORT, LEARN, ONE, PREDICT, RUN, Bad
from tests.bad_input.place import Place

POSE = {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}


def nothing(place: Place) -> None:
    """The command line alone is wrong."""


def in_the_way(place: Place) -> None:
    place.put("file", "no folder")


def space(place: Place) -> None:
    place.put("space.yaml", "space: {optimizer.lr: 'interval(0.001,0.01)'}\n")


def configured(name: str, word: str, said: str) -> Bad:
    return Bad(f"configuration: {name}", nothing, ("preset=smoke", "logger=none", word), said, 2)


def argument(words: tuple[str, ...], said: str, status: int = 2, **view: Any) -> Bad:
    """A verb with wrong arguments, or with a line of a view that has more keys."""

    def spoil(place: Place) -> None:
        if view:
            place.put(place.metadata, json.dumps({"file_name": "0.png", "f": 300} | view) + "\n")

    return Bad(f"argument: {' '.join(words)}, {view}", spoil, words, said, status)


ENDS = {"optimiser.lr=0.01": "optimizer.lr", "epochs=3": "trainer.max_epochs"}
"""Words whose key is known by its end, and the key."""
SPACES = {"model = mae_vz": "model=mae_vz", "-m seed=0, 1": "seed=0,1", "data.z_range=[3, 5]": "'data.z_range=[3,5]'"}
"""Words that a shell splits at spaces, and what was meant."""
CONFIGURATIONS = [
    Bad("configuration: a flag that returns the carriage", nothing, ("preset=smoke", "--cfg\r"), r"--cfg: holds control characters; expected printable KEY=VALUE", 2),
    configured("a flag that there is not", "--nonsense", r"unrecognized arguments: --nonsense; see `python -m phd_exp --help`"),
    configured("a flag without its value", "-c", r"argument --cfg/-c: expected one argument; .*"),
    configured("a group set to null", "model=null", r"Config group override must be a string or a list\..*"),
    configured("a part set to null", "model.head=null", r"model\.head: got None; expected a valid dictionary"),
    configured("a partial that is no bool", "+loss._partial_=3", r"loss\._partial_: got 3; expected a bool"),
    configured("an interpolation kept as text", r"model.name='a\${b}'", r"model\.name: got 'a\$\{b\}'; expected a value, since no interpolation .*"),
    configured("an interpolation to nowhere", "seed=${nope}", r"Interpolation key 'nope' not found.*"),
    configured("an infinite learning rate", "optimizer.lr=inf", r"optimizer\.lr: got inf; expected to be a finite number"),
    configured("a folder without a name", "runs=''", r"runs: got ''; expected the name of a folder"),
    configured("brackets without end", "+a=" + "[" * 2000, r"[^\n]{1,420}"),
    configured("an empty word", "", r": no KEY=VALUE; .*"),
    *(configured(f"the end of a key, {word}", word, rf"{word.split('=')[0]}: unknown key, did you mean '{key}'\?; expected one of backbone, .*") for word, key in ENDS.items()),
    configured("an argument that the files do not name", "trainer.gradient_clip_val=1", r"trainer\.gradient_clip_val: unknown key; .* \+trainer\.gradient_clip_val=VALUE"),
    configured("a key of a launcher", "hydra.launcher.partiton=x", r"hydra\.launcher\.partiton: unknown key; expected a choice with keys: hydra/launcher=CHOICE"),
    Bad("configuration: a key that is nearly one of a launcher", nothing, ("-m", "hydra/launcher=submitit_slurm", "hydra.launcher.partiton=x"), r"hydra\.launcher\.partiton: unknown key, did you mean 'hydra\.launcher\.partition'\?.*", 2),
    configured("a key of another section", "trainer.batch_size=8", r"trainer\.batch_size: unknown key, did you mean 'data\.batch_size'\?; .*"),
    configured("a key of a part that is not chosen", "callbacks.early_stopping.patience=3", r"callbacks\.early_stopping\.patience: .* of callbacks=early_stopping; name that choice too"),
    configured("one of several choices", "callbacks=[early_stopping,nosuch]", r"callbacks=nosuch: no such choice; expected one of best_checkpoint, .*lr_monitor"),
    configured("a key of the backbone of another recipe", "backbone.width=8", r"backbone\.width: not a key of this choice, but of recipe=strong backbone=resnet; .*"),
    configured("a size of the presets", "network.width=8", r"network\.width: set by presets and recipes; expected the key of the run, such as backbone\.width"),
    configured("the ablation of earlier versions", "without=muon", r"without: unknown key.*; expected one of backbone, .*"),
    configured("a choice without its group", "strong", r"strong: no KEY=VALUE, did you mean 'recipe=strong'\?; .*"),
    configured("no end of a list", "data.n_train=[", r"data\.n_train=\[: .*; expected KEY=VALUE without spaces, or with the value in quotes, .*"),
    *(Bad(f"configuration: spaces, {text}", nothing, (*text.split(" "), "preset=smoke"), rf"{re.escape(text.removeprefix('-m '))}: has spaces; expected {re.escape(mended)}", 2) for text, mended in SPACES.items()),
    configured("a key that is nearly one", "data.ntrain=3", r"data\.ntrain: unknown key, did you mean 'data\.n_train'\?; expected one of n_train, .*"),
    configured("a group that is nearly one", "modle=mae_vz", r"modle: .*did you mean 'model'.*"),
    configured("a choice that is nearly one", "model=mae_log", r"model=mae_log: .*did you mean 'mae_logz'.*probabilistic.*"),
    configured("a key of another choice", "data.folder=photos", r"data\.folder: .*not a key of this choice.*data=folder.*"),
    configured("several runs at once", "experiment=table1", r"experiment=table1: names several runs; write -m before it: -m .*experiment=table1"),
    Bad("configuration: a key that is nearly one of render", nothing, ("render", "preset=smoke", "shrad=0/2"), r"shrad: unknown key, did you mean 'shard'\?; expected one of backbone,.*", 2),
    Bad("configuration: an experiment that is nearly one", nothing, ("-m", "preset=smoke", "experiment=fusion,tabel2"), r"experiment=tabel2: no such choice, did you mean 'table2'\?.*", 2),
    Bad("configuration: an experiment with another optimizer", nothing, ("-m", "preset=smoke", "experiment=ablation", "optimizer=adam"), r"preset=smoke experiment=ablation optimizer=adam: its job .*optimizer\.weight_decay=0 cannot be composed: optimizer\.weight_decay: .*optimizer=muon; .*", 2),
    Bad("configuration: no experiment", nothing, ("-m", "preset=smoke", "experiment=glob(nothing*)"), r".*experiment=glob\(nothing\*\): .*not one combination.*", 2),
    Bad("configuration: an unknown verb", nothing, ("trian",), r"trian: no KEY=VALUE, did you mean 'train'\?; .*train, render, report.*", 2),
    Bad("configuration: a folder without images", nothing, (*LEARN, "data.folder=nowhere"), r"nowhere/train: no such folder.*"),
    Bad("configuration: data in a file", in_the_way, ("preset=smoke", "logger=none", "data.root=file/renders"), r".*file/renders.*"),
    Bad("configuration: runs in a file", in_the_way, ("preset=smoke", "logger=none", "runs=file/runs"), r".*file.*runs=DIR.*"),
    Bad("configuration: a sweep in a file", in_the_way, ("-m", "preset=smoke", "runs=file/runs"), r"file/runs/\.sweep: Not a directory; mend that, and the same command resumes"),
    Bad("configuration: a search without held-out samples", space, ("search", "space.yaml", "trials=1", *LEARN), r"data\.n_held_out: got 0.*", 2),
    Bad("configuration: a search with a sampler that there is not", lambda place: place.put("space.yaml", "space: {}\nsampler: {_target_: optuna.samplers.Nope}\n"), ("search", "space.yaml", "trials=1", *LEARN), r"space\.yaml: sampler\._target_: 'optuna\.samplers\.Nope' cannot be imported .*", 2),
    Bad("configuration: a search with a wrong key", space, ("search", "space.yaml", "trials=1", *LEARN, "optimizer.lrr=1"), r"optimizer\.lrr: unknown key.*", 2),
    Bad("configuration: a shift of what is not rendered", nothing, (*LEARN, "shift=scenes"), r"evaluation\.shifts\.short_f\.data: data=folder is not rendered; leave out this shift.*", 2),
    Bad("configuration: an error of a focal length that is not used", nothing, ("preset=smoke", "camera=constant", "camera.f_error=0.1"), r"camera: f_error: got 0\.1; camera=constant uses no focal length; .*", 2),
    configured("a start from no run", "init=nowhere", r"init: got nowhere; expected the folder of a finished run"),
    Bad("configuration: a start from another network", nothing, (*LEARN, "runs=others", "init=RUN", "backbone.width=16"), r"init: .*\(.*size mismatch.*\); expected model=probabilistic, and no words for the network, .*", 2),
    configured("a shift by a negative factor", "+evaluation.shifts.a.f_factor=-1", r"evaluation\.shifts\.a\.f_factor: got -1; expected .*"),
    configured("a shift of images without a name", "+evaluation.shifts.a.images.hue=1", r"evaluation\.shifts\.a\.images\.hue.*"),
    configured("a shift that is no file name", "+evaluation.shifts={a/b:{f_factor:2}}", r"evaluation\.shifts\.a/b\.\[key\]: got 'a/b'.*"),
    configured("a shift to an empty range", "+evaluation.shifts.a.data.z_range=[5,4]", r"evaluation\.shifts\.a\.data: z_range: got \[5, 4\].*"),
    configured("a shift of no data set", "+evaluation.shifts.a.data.depth=5", r"evaluation\.shifts\.a\.data: depth: got 5.*"),
    configured("a name that is not UTF-8", "runs=r\udcff", r"runs='r\?': is not UTF-8, as the record of a run is; rename the file or folder"),
    Bad("configuration: a zero byte", nothing, ("preset=smoke", "runs=a\0b"), r"runs=a\?b: holds control characters; .*", 2),
    *(Bad(f"configuration: {word}", nothing, ("-m", "preset=smoke", word), r"seed=range\(0,.*\): more than 10000 jobs; .*", 2) for word in ("seed=range(0,1e9)", "seed=range(0,nan)")),
    Bad("configuration: two long ranges", nothing, ("-m", "preset=smoke", "seed=range(0,9999)", "data.seed=range(0,9999)"), r"preset=smoke seed=.*: more than 10000 jobs; .*", 2),
    Bad("configuration: a folder with a long name", nothing, ("preset=smoke", "logger=none", f"runs={'a' * 300}"), r"a{300}.*: File name too long; .*"),
    Bad("configuration: a folder that cannot be made", nothing, ("preset=smoke", "hydra.run.dir=/proc/nope"), r"/proc/nope: No such file or directory; .*"),
]  # fmt: skip

HERE = ("predict", RUN, "image=photos/test/0.png")
NOWHERE = ("fuse", "run=nowhere", "folder=photos/test")
ARGUMENTS = [
    argument((*ONE, "folder=."), r"predict: expected either image=FILE.*"),
    argument((*PREDICT, "f=400"), r"photos/test: has annotations, .*metadata\.jsonl; expected images alone, or no f=.*", 1),
    argument((*PREDICT, "f=400", "object=1"), r"object: selects detections.*"),
    argument((*ONE, "boxes=b.json", "box=1,2,3,4"), r"box, boxes: got both; expected one of them"),
    argument((*PREDICT, "f=400", "boxes=b.json"), r"boxes: the boxes of one image=FILE; expected no folder=.*"),
    argument(("predict", RUN, "folder=nowhere", "camera=c.yaml"), r"nowhere: no images; expected a folder with files \*\.png.*", 1),
    argument(("predict", RUN, "folder=nowhere"), r"nowhere: no such folder.*", 1),
    argument((*HERE, "camera=no.yaml"), r"no\.yaml: cannot be read \(No such file or directory\).*", 1),
    argument((*ONE, "run=nowhere"), r"run: given twice.*"),
    argument(("predict", RUN, "imag=good.png"), r"imag: unknown key, did you mean 'image'\?.*"),
    argument(("predict", RUN, "good.png"), r"good\.png: expected key=value.*"),
    argument((*ONE, "out=photos/test/0.png/x"), r"photos/test/0\.png/x: cannot be written.*"),
    argument((*ONE, "view=photos"), r"view: got photos; expected a file \*\.rrd, such as view\.rrd"),
    argument((*ONE, "curve=true"), r"curve: is drawn into the pictures; expected out=.*"),
    argument(("predict", "run=x", "image=y", "views=3"), r"views: got '3'; expected to be '1' or '8'.*"),
    argument(("predict", "image=a.png"), r"run: missing; predict takes run=.*"),
    argument((*ONE, "calibration=garden"), r"calibration: got garden; expected a name of `calibrate`.*", 1),
    argument((*ONE, "calibration=a", "recalibrate=true"), r"calibration: recalibrates a single run.*"),
    argument(("calibrate", RUN, "folder=photos/test", "name=a/b"), r"name: got 'a/b'.*"),
    argument((*ONE, "margin=0.9"), r"margin: got '0\.9'; expected to be greater than or equal to 1"),
    argument((*ONE, "coverage=1"), r"coverage: got '1'; expected to be less than 1"),
    argument((*ONE, "coverage=nan"), r"coverage: got 'nan'; expected to be.*"),
    argument((*ONE, "groups=spread"), r"groups: guarantees a coverage; expected coverage=0\.9.*"),
    argument((*ONE, "coverage=0.9"), r"runs/.*/held_out\.parquet: missing; held-out samples are needed: train with.*", 1),
    argument(("export",), r"run: missing; export takes run=, recalibrate=, calibration=, trust=, views=, margin=, out=, coverage=.*"),
    argument(("export", "run=.", "out=."), r"out=\.: is a folder.*"),
    argument((*EXPORT, "margin=1.2"), r"margin: enlarges boxes; expected photographs=true too"),
    argument(("fuse", "run=nowhere"), r"folder: missing; fuse takes run=.*"),
    argument(NOWHERE, r"nowhere: no run; expected a folder with config\.yaml.*", 1, scene=1, pose=POSE),
    argument(("predict", "run=runs/smoke", "image=photos/test/0.png", "f=300"), r"runs/smoke: no run; expected one of the runs below it: runs/smoke/folder/probabilistic/seed0-.*", 1),
    argument((*NOWHERE, "plane=0,0,0,1"), r"plane: .*a normal that is not zero.*", scene=1, pose=POSE),
    argument((*NOWHERE, "plane=0,0,1e308,1"), r"plane: .*expected finite numbers up to 1e9.*", scene=1, pose=POSE),
    argument((*NOWHERE, "plane=0,nan,0,1"), r"plane: .*expected finite numbers.*", scene=1, pose=POSE),
    argument((*NOWHERE, "out=photos/test/metadata.jsonl"), r"out=.*: is one of the files that are read.*", scene=1, pose=POSE),
    argument(("fuse", RUN, "folder=photos/test", "coverage=0.9", "plane=0,0,1,3"), r"coverage: holds for views that are fused.*", scene=1, pose=POSE),
    argument(("fuse", RUN, "folder=photos/test", "coverage=0.9"), r"runs/.*/views\.parquet: no scenes with 1 cameras, as coverage= needs; .*", 1, scene=1, pose=POSE),
    argument(NOWHERE, r".*line 1: scene or pose is missing.*", 1),
    argument(NOWHERE, r".*line 1: scene or pose is missing; .* the rotation \[w, x, y, z\].*", 1, scene=1),
    argument(NOWHERE, r".*line 1: scene: got True; expected a whole number or a name.*", 1, scene=True, pose=POSE),
    argument(NOWHERE, r".*pose\.rotation: got \[1, 1, 0, 0\]; a rotation is.*", 1, scene=1, pose=POSE | {"rotation": [1, 1, 0, 0]}),
    argument(NOWHERE, r".*line 1: pose\.translation: missing.*", 1, scene=1, pose={"rotation": [1, 0, 0, 0]}),
    argument(NOWHERE, r".*pose\.R: unknown key; expected one of rotation, translation.*", 1, scene=1, pose=POSE | {"R": 1}),
    argument(("report", "runs=x"), r"x: no such folder; train first, or name another by runs=DIR", 1),
    argument(("report", "out=photos/test/0.png"), r"photos/test/0\.png/.*: cannot be written \(.*", 1),
    argument(("render", "preset=smoke", "masks=renders/default/masks"), r"masks=renders/default/masks: lies in the data set itself.*", 1),
    argument(("render", "preset=smoke", "bop=bop", "data.image_format=webp"), r"data\.image_format: got webp; BOP has no such images.*"),
    argument(("render", "preset=smoke", "verify=true"), r".*no data set here.*", 1),
]  # fmt: skip
