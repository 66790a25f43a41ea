"""Every named bad input; those of the command line alone are in commands.py."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from PIL import Image

from tests.bad_input import images
from tests.bad_input.archives import ARCHIVES
from tests.bad_input.bad import LEARN, LEARN_HANDMADE, ONE, PREDICT, RUN, VERIFY, Bad
from tests.bad_input.commands import ARGUMENTS, CONFIGURATIONS, nothing
from tests.bad_input.place import Place
from tests.support.foreign import WRITERS


def photo(name: str, content: bytes | Callable[[], bytes], said: str) -> Bad:
    def spoil(place: Place) -> None:
        place.put(place.photo, content if isinstance(content, bytes) else content())

    return Bad(f"image: {name}", spoil, PREDICT, rf"photos/test/0\.png: {said}")


def line(name: str, text: str, said: str) -> Bad:
    def spoil(place: Place) -> None:
        place.put(place.metadata, text.encode(errors="surrogateescape"))

    return Bad(f"metadata: {name}", spoil, PREDICT, rf"photos/test/metadata\.jsonl, line 1: {said}")


def label(name: str, said: str, **changes: Any) -> Bad:
    def spoil(place: Place) -> None:
        file = place.root / "photos/train/metadata.jsonl"
        first, *rest = file.read_text().splitlines()
        place.put(file, "\n".join([json.dumps(json.loads(first) | changes), *rest]) + "\n")

    where = r"photos/train/metadata\.jsonl, line 1: "
    return Bad(f"label: {name}", spoil, (*LEARN, "runs=others"), where + said)


def foreign(form: str, name: str, word: str, said: str, without: str | None = None) -> Bad:
    def spoil(place: Place) -> None:
        WRITERS[form](place.root / form / "test")
        if without:
            (place.root / form / without).unlink()

    return Bad(f"{form}: {name}", spoil, ("predict", RUN, f"folder={form}/test", word), rf"{form}/test(/|: )?{said}")


def camera(name: str, words: tuple[str, ...], said: str, status: int = 1) -> Bad:
    return Bad(f"intrinsics: {name}", nothing, (*ONE[:3], *words), said, status)


def checkpoint(name: str, spoil: Callable[[Place], Any], said: str, resumed: bool = False) -> Bad:
    """A checkpoint that is predicted with, or resumed."""

    def interrupted(place: Place) -> None:
        spoil(place)
        place.put_json(place.run.status_file, state="interrupted")

    said = rf"runs/.*/last\.ckpt: {said}"
    if resumed:
        return Bad(f"checkpoint: {name}, resumed", interrupted, LEARN, said)
    return Bad(f"checkpoint: {name}", spoil, ONE, said)


def stored(name: str, said: str, status: int = 2, **changes: Any) -> Bad:
    """A stored configuration, which predict builds from."""
    return Bad(f"stored configuration: {name}", lambda place: place.put_config(**changes), ONE, said, status)


def record(name: str, said: str, image: bytes | Callable[[], bytes] | None = None, **changes: Any) -> Bad:
    """A rendered data set that is verified."""

    def spoil(place: Place) -> None:
        place.put_record(image() if callable(image) else image, **changes)

    return Bad(f"rendered: {name}", spoil, VERIFY, r"/.*/renders/handmade/test/" + said)


def status(**changes: Any) -> Callable[[Place], None]:
    return lambda place: place.put_json(place.run.status_file, **changes)


GOOD = '"file_name": "0.png", "f": 300'
DEEP = "[" * 100_000
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)

KINDS = r"cannot be read as an image \(of another kind\); expected a whole image \(PNG, .*\)"
PICTURES = [
    photo("zero bytes", b"", KINDS),
    photo("SVG", images.SVG, KINDS),
    photo("PostScript", images.POSTSCRIPT, KINDS),
    photo("a head alone", b"\x89PNG\r\n\x1a\n", KINDS),
    photo("cut off", lambda: images.saved(images.noise(32, 32, 3))[:900], r"cannot be read as an image \(.*\); expected a whole image .*"),
    photo("damaged", images.damaged, r"cannot be read as an image \(.*\); expected a whole image .*"),
    photo("65535 x 65535 declared", images.declared_png(65535, 65535), r"cannot be read as an image \(Image size .* exceeds limit of .*"),
    photo("10000 x 10000 declared", images.declared_png(10_000, 10_000), r"cannot be read as an image \(Image size .* exceeds limit of .*"),
    photo("a bomb in a comment", images.text_bomb, r"cannot be read as an image \(Decompressed data too large.*\); .*"),
    photo("animated GIF", lambda: images.animated("gif"), r"holds several pictures; expected one, .*"),
    photo("TIFF of several pages", lambda: images.animated("tiff"), r"holds several pictures; expected one, .*"),
    photo("turned by EXIF", images.turned, r"has the EXIF orientation 6, .*"),
    photo("32 bits", lambda: images.saved(Image.fromarray(np.zeros((8, 8), dtype=np.int32)), "tiff"), r"has colours of the kind 'I'; .*"),
    photo("Lab colours", lambda: images.saved(Image.new("LAB", (8, 8)), "tiff"), r"has colours of the kind 'LAB'; .*"),
    Bad("image: a pipe", lambda place: images.pipe(place.photo), PREDICT, r"photos/test/0\.png: cannot be read \(a pipe or a device; .*\)"),
    Bad("image: a pipe to train on", lambda place: images.pipe(place.root / "photos/train/0.png"), (*LEARN, "runs=others"), r".*line 1: .*0\.png: cannot be read as an image \(a pipe or a device; .*"),
    Bad("image: 65535 x 65535 declared, to train on", lambda place: place.put("photos/train/0.png", images.declared_png(65535, 65535)), (*LEARN, "runs=others"), r".*line 1: .*0\.png: cannot be read as an image \(Image size .* exceeds limit of .*"),
    Bad("image: a device", nothing, ("predict", RUN, "image=/dev/zero", "f=300"), r"/dev/zero: cannot be read \(a pipe or a device; expected a plain file\)"),
    Bad("image: a folder", nothing, ("predict", RUN, "image=photos", "f=300"), r"photos: cannot be read \(Is a directory\)"),
    Bad("image: a detection in a folder", lambda place: place.put("dot/metadata.jsonl", '{"file_name": ".", "f": 400}'), ("predict", RUN, "folder=dot"), r"dot: cannot be read \(Is a directory\)"),
    Bad("image: gone", lambda place: place.photo.unlink(), PREDICT, r"photos/test/0\.png: cannot be read \(No such file or directory\)"),
]  # fmt: skip

LINES = [
    line("no camera", '{"file_name": "0.png"}\n', r"expected either f, or fx and fy.*"),
    line("not JSON", "{", r"not JSON \(.*\); expected one object a line"),
    line("nesting without end", f'{{{GOOD}, "box": {DEEP}}}\n', r"not JSON \(nested too deeply\); .*"),
    line("a number of 5000 digits", f'{{"file_name": "0.png", "f": {"9" * 5000}}}\n', r"not JSON \(a whole number of 5000 digits\); .*"),
    line("a number of 400 digits", f'{{"file_name": "0.png", "f": {"9" * 400}}}\n', r"not JSON \(a whole number of 400 digits\); .*"),
    line("a key given twice", f'{{{GOOD}, "f": 301}}\n', r"not JSON \(the key 'f' is given twice\); .*"),
    line("a line of 2 MB", f'{{{GOOD}, "x": "{"a" * 2_000_000}"}}\n', r"not a valid record \(longer than 1000000 bytes\)"),
    line("no text", '{"file_name": "\udcff"', r"not a valid record \(.*codec can't decode.*\)"),
    line("a name that leads up", '{"file_name": "../../secret.png", "f": 300}\n', r"file_name='\.\./\.\./secret\.png' is no file name \(leaves .*"),
    line("a name of two lines", '{"file_name": "a\\nerror: b.png", "f": 300}\n', r"file_name='a\\nerror: b\.png' is no file name .*"),
    line("a name that steers the terminal", '{"file_name": "\\u001b[2J.png", "f": 300}\n', r"file_name='\\x1b\[2J\.png' is no file name .*"),
    line("a name of half a character", '{"file_name": "\\ud800.png", "f": 300}\n', r"file_name: got '\\ud800\.png'; expected a valid string, .*"),
    line("a name without end", f'{{"file_name": "{"a" * 5000}.png", "f": 300}}\n', r"file_name: got 'a{50,}\.\.\.; String should have at most 1000 characters"),
    Bad("metadata: a link out", lambda place: (place.photo.rename(place.root / "secret.png"), images.link(place.photo, "../../secret.png")), PREDICT, r".*line 1: file_name='0\.png' is no file name \(leaves .*"),
    Bad("metadata: a link to itself", lambda place: images.link(place.photo, "0.png"), PREDICT, r".*0\.png.*(no file name|cannot be read|leaves).*"),
    Bad("metadata: a pipe", lambda place: images.pipe(place.metadata), PREDICT, r"photos/test/metadata\.jsonl: cannot be read \(a pipe or a device; .*\); .*"),
    Bad("metadata: empty", lambda place: place.put(place.metadata, ""), PREDICT, r"photos/test/metadata\.jsonl: some detections asked for, 0 found"),
    Bad("metadata: a folder", lambda place: (place.metadata.unlink(), place.metadata.mkdir()), PREDICT, r"photos/test/metadata\.jsonl: cannot be read \(Is a directory\); .*"),
]  # fmt: skip

LABELS = [
    label("NaN", r"x: got nan; expected to be a finite number", x=float("nan")),
    label("a focal length in metres", r"f: got 0\.004; expected to be greater than or equal to 0\.01", f=0.004),
    label("no position", r"x, y, z are missing; .*", x=None, y=None, z=None),
    label("millimetres", r"the position \[0\.0, 0\.0, 4000\.0\] is so far away that its box is .* m wide there; .*; if these are millimetres, divide them by 1000", x=0, y=0, z=4000),
    Bad("label: millimetres to predict", lambda place: place.put(place.metadata, f'{{{GOOD}, "x": 0, "y": 0, "z": 4000}}\n'), PREDICT, r"photos/test/metadata\.jsonl, line 1: the position .* is so far away that its box is .*"),
    label("millimetres across", r"the position \[-200\.0, .*\] is far outside the image of .*; check x, y, z \(m\) and the camera", x=-200),
]  # fmt: skip

FORMATS = [
    foreign("bop", "an object that there is not", "object=7", r"no object '7' here; expected one of 5"),
    foreign("coco", "no images", "object=cup", r"b\.png: cannot be read \(No such file or directory\)", "test/b.png"),
]  # fmt: skip

CAMERAS = [
    camera("none", (), r"photos/test/0\.png: expected either f, or fx and fy \(focal length in pixels\), or camera \(a file\) alone"),
    camera("NaN", ("f=nan",), r"photos/test/0\.png: f: got nan; expected to be a finite number"),
    camera("beyond all numbers", ("f=1e400",), r"photos/test/0\.png: f: got inf; expected to be a finite number"),
    camera("text", ("f=wide",), r"f: got 'wide'; expected a valid number, .*", 2),
    camera("a box of three numbers", ("f=300", "box=1,2,3"), r"box: got '1,2,3'; expected box=LEFT,TOP,RIGHT,BOTTOM in pixels", 2),
]  # fmt: skip


def trap(place: Place) -> None:
    place.put_checkpoint(state_dict=Trap("owned"))


class Trap:
    """Unpickled by a careless reader, it writes a file."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"open({self.name!r}, 'w').close()",)


def repeat(place: Place) -> None:
    """A small file that names large weights."""
    weights = torch.load(place.run.last_checkpoint, weights_only=True)["state_dict"]
    place.put_checkpoint(state_dict=weights | {"regressor.last.bias": torch.zeros(1).expand(7)})


def diverge(place: Place) -> None:
    weights = torch.load(place.run.last_checkpoint, weights_only=True)["state_dict"]
    weights["regressor.last.bias"][0] = torch.nan
    place.put_checkpoint(state_dict=weights)


def shrunk(place: Place) -> None:
    """As a packed archive, which could unfold without end."""
    import zipfile

    file = place.run.last_checkpoint
    with zipfile.ZipFile(file) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    file.unlink()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content[:1000])


CHECKPOINTS = [
    *(checkpoint("code", trap, r"not a whole checkpoint \(holds more than tensors and plain values, .*\); .*", resumed) for resumed in (False, True)),
    checkpoint("torn", lambda place: place.put(place.run.last_checkpoint, b"torn"), r"not a whole checkpoint \(File is not a zip file\); .*"),
    checkpoint("a pickle", lambda place: place.put(place.run.last_checkpoint, b"\x80\x04cos\nsystem\n(S'touch owned'\ntR."), r"not a whole checkpoint \(.*\); .*"),
    checkpoint("packed", shrunk, r"not a whole checkpoint \(its content is compressed, .*\); .*"),
    checkpoint("a list", lambda place: (place.run.last_checkpoint.unlink(), torch.save([1], place.run.last_checkpoint)), r"not a whole checkpoint \(not of a run\); .*"),
    checkpoint("a pipe", lambda place: images.pipe(place.run.last_checkpoint), r"not a whole checkpoint \(a pipe or a device; .*\); .*"),
    checkpoint("weights of another network", lambda place: place.put_checkpoint(state_dict={"regressor.last.bias": torch.zeros(7)}), r"not a (whole )?checkpoint of this (network|run) \(.*"),
    checkpoint("weights that are none", lambda place: place.put_checkpoint(state_dict=[1, 2]), r"not a (whole )?checkpoint of this (network|run) \(.*"),
    checkpoint("weights that repeat one number", repeat, r"not a whole checkpoint of this network \(last\.bias: repeats numbers.*\)"),
    Bad("checkpoint: gone", lambda place: place.run.last_checkpoint.unlink(), ONE, r"runs/.*/last\.ckpt: missing; the run has not trained a whole epoch yet.*"),
    Bad("checkpoint: diverged", diverge, ONE, r"photos/test/0\.png: the network returns numbers that are not finite; train the run again.*"),
    checkpoint("an epoch that never was", lambda place: place.put_checkpoint(epoch=10**12), r"not a checkpoint of this run \(epoch 1000000000000 of 1\); .*", resumed=True),
    checkpoint("loops of another trainer", lambda place: place.put_checkpoint(loops={"fit_loop": 3}), r"not a checkpoint of this run \(.*\); .*", resumed=True),
]  # fmt: skip


REFUSED = r"is not built from a stored configuration.*"
STORED = [
    stored("a system call", rf"backbone\._target_: 'os\.system' {REFUSED}", backbone={"_target_": "os.system", "command": "touch owned"}),
    stored("what a module imports", r"backbone\._target_: .* is only imported there; .*", backbone={"_target_": "torchvision.models._api.importlib.import_module"} | {"_target_": "phd_exp.models.residual.partial"}),
    stored("a variable of the environment", r"data\.folder: got '\$\{oc\.env:HOME\}'; expected a value, .*", data__folder="${oc.env:HOME}"),
    stored("an abstract class", r"(backbone: .*|runs/.*/config\.yaml: describes no network \(.*\); use the version .*)", backbone={"_target_": "phd_exp.models.backbones.Backbone"}),
    stored("a head that has left", r"model\.head\._target_: .* no attribute 'QuantileHead'\); use the version of phd_exp that recorded the run.*", model={"name": "quantiles", "head": {"_target_": "phd_exp.models.heads.QuantileHead"}}),
    stored("a head whose kind has left", r"model\.head: missing a required argument: 'is_rounded'; use the version of phd_exp that recorded the run.*", model={"name": "free_axis_t", "head": {"_target_": "phd_exp.models.heads.SurrogateHead"}}),
    stored("a network larger than its weights", r"runs/.*/last\.ckpt: not a whole checkpoint of this network \(.*\)", 1, backbone={"_target_": "phd_exp.models.locating.Locating", "depth": 50, "width": 64_000, "stride": 4, "channels": 64_000}),
    stored("a wrong type", r"data: got 'x'; expected a valid dictionary.*", data="x"),
    stored("keys that are no text", r"evaluation\.1: .*[Kk]eys? .*", evaluation={"calibration_window": 200, "calibration_every_n_epochs": 10, 1: 2}),
    Bad("stored configuration: gone", lambda place: place.run.config_file.unlink(), ONE, r"runs/.*seed0-.*: no run; expected a folder with config\.yaml and .*"),
    Bad("stored configuration: objects", lambda place: place.put(place.run.config_file, "!!python/object/apply:os.system ['touch owned']"), ONE, r"runs/.*/config\.yaml: cannot be read \(could not determine a constructor .*\); .*"),
    Bad("stored configuration: a billion laughs", lambda place: place.put(place.run.config_file, BOMB), ONE, r"runs/.*/config\.yaml: cannot be read \(the alias \*a stands for another part; write it out\); .*"),
    Bad("stored configuration: itself", lambda place: place.put(place.run.config_file, "&a\nb: *a"), ONE, r"runs/.*/config\.yaml: cannot be read \(the alias \*a .*\); .*"),
    Bad("stored configuration: nesting without end", lambda place: place.put(place.run.config_file, "a: " + "[" * 20_000), ONE, r"runs/.*/config\.yaml: cannot be read \(nested too deeply\); .*"),
    Bad("stored configuration: a key twice", lambda place: place.put(place.run.config_file, "a: 1\na: 2"), ONE, r"runs/.*/config\.yaml: cannot be read \(the key 'a' is given twice\); .*"),
    Bad("stored configuration: 2 MB", lambda place: place.put(place.run.config_file, "a: " + "b" * 2_000_000), ONE, r"runs/.*/config\.yaml: cannot be read \(2 MB; expected at most 1 MB\); .*"),
    Bad("stored configuration: a pipe", lambda place: images.pipe(place.run.config_file), ONE, r"runs/.*/config\.yaml: cannot be read \(a pipe or a device; .*\); .*"),
    Bad("stored configuration: a list", lambda place: place.put(place.run.config_file, "[1]"), ONE, r"runs/.*/config\.yaml: cannot be read \(a list; expected a mapping\); .*"),
    Bad("constants: negative", lambda place: place.put_json(place.run.constants_file, mu_z0=-1), ONE, r"runs/.*/constants\.json: not the constants of a run \(mu_z0 must be 1e-09 to 1e\+09, but is -1\.0\)"),
    *(Bad(f"constants: {name} is {value}", lambda place, name=name, value=value: place.put_json(place.run.constants_file, **{name: value}), ONE, rf"runs/.*/constants\.json: not the constants of a run \({name} must be .*\)") for name in ("mu_z0", "D", "z_centre", "constant_f") for value in (1e308, 1e-308)),
    Bad("constants: no number", lambda place: place.put_json(place.run.constants_file, constant_f=[]), ONE, r"runs/.*/constants\.json: not the constants of a run \(.*\)"),
    Bad("constants: an infinite camera", lambda place: place.put(place.run.constants_file, place.run.constants_file.read_text().replace('"constant_f": ', '"constant_f": 1e999, "was": ')), ONE, r"runs/.*/constants\.json: not the constants of a run \(constant_f must be .*\)"),
    Bad("constants: gone", lambda place: place.run.constants_file.unlink(), ONE, r"runs/.*/constants\.json: missing, so that .*"),
]  # fmt: skip

RECORDS = [
    record("a name that leads up", r"metadata\.jsonl, line 1: not a valid record \(.*file_name.*\)", file_name="../../../secret.png"),
    record("behind the camera", r"metadata\.jsonl, line 1: not a valid record \(z: got -1\.0; expected .*greater than 0\)", z=-1.0),
    record("an image too small", r"000000\.png: cannot be read as an image \(\(32, 32\) pixels of RGB; expected 64 x 64 of RGB\); .*", lambda: images.saved(images.noise(32, 32, 3))),
    record("transparent", r"000000\.png: cannot be read as an image \(\(64, 64\) pixels of RGBA; .*", lambda: images.saved(images.noise(64, 64, 4))),
    record("PostScript", r"000000\.png: cannot be read as an image \(.*\); .*", images.POSTSCRIPT),
    Bad("rendered: transparent, trained on", lambda place: place.put_record(images.saved(images.noise(64, 64, 4))), LEARN_HANDMADE, r"/.*/renders/handmade/test/000000\.png: cannot be read as an image \(\(64, 64\) pixels of RGBA; .*"),
    Bad("rendered: a pipe", lambda place: images.pipe(place.handmade.image_path("test", 0)), VERIFY, r".*000000\.png: cannot be read \(a pipe or a device; .*"),
    Bad("rendered: a manifest of nesting without end", lambda place: place.put("renders/handmade/manifest.json", DEEP), VERIFY, r".*manifest\.json: not a readable manifest \(.*\); .*"),
    Bad("rendered: a manifest of 20 MB", lambda place: place.put("renders/handmade/manifest.json", " " * 20_000_000), VERIFY, r".*manifest\.json: not a readable manifest \(.*20 MB; expected at most 16 MB.*\); .*"),
]  # fmt: skip

FOLDERS = [
    Bad("run folder: no numbers before the checkpoint", lambda place: (place.run.metrics_file.unlink(), status(state="interrupted")(place)), LEARN, r"runs/.*metrics\.jsonl: not the record of the epochs before last\.ckpt; .*"),
    Bad("run folder: an epoch of text", lambda place: (place.put(place.run.metrics_file, '{"epoch": "x"}\n'), status(state="interrupted")(place)), LEARN, r"runs/.*metrics\.jsonl, line 1: not a valid record \(epoch.*\)"),
    Bad("run folder: numbers of text", lambda place: (place.put(place.run.metrics_file, '{"epoch": -1, "test/nll": "<b>"}\n'), status(state="interrupted")(place)), LEARN, r"runs/.*metrics\.jsonl, line 1: not a valid record \(test/nll.*"),
    Bad("run folder: a result of 400 digits", lambda place: place.put(place.run.results_file, f'{{"test/nll": {"9" * 400}}}'), LEARN, r"runs/.*results\.json: cannot be read \(a whole number of 400 digits\); .*"),
    Bad("run folder: checkpoints that lead elsewhere", lambda place: (place.run.checkpoints.rename(place.root / "elsewhere"), place.run.checkpoints.symlink_to(place.root / "elsewhere"), status(state="interrupted")(place)), LEARN, r"runs/.*/checkpoints: is a link; .*"),
    Bad("run folder: a lock that leads elsewhere", lambda place: (place.put("diary", "dear"), images.link(place.run.path / ".lock", place.root / "diary"), status(state="interrupted")(place)), LEARN, r"runs/.*/\.lock: is a link; .*"),
]  # fmt: skip


TABLE = [
    *CONFIGURATIONS, *PICTURES, *LINES, *LABELS, *FORMATS, *CAMERAS, *ARGUMENTS, *CHECKPOINTS, *STORED, *RECORDS, *ARCHIVES, *FOLDERS,
]  # fmt: skip
