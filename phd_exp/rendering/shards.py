"""One share of a data set: several processes, on one machine or many, render one folder at once.

Locks, in the folder's `.cache`:

    render.lock              held together by all shards, alone by an unsharded render and by whoever seals
    shard-<i>-of-<n>.lock    held alone by the process that renders this share
    begin.lock               held alone for the moment in which the manifest is begun

A shard that has finished lets its locks go and then tries to take `render.lock` alone. That fails while another
shard renders, which will try in its turn; so the last one to finish succeeds, and seals. If it is killed
before, the folder waits for any later render, which finds all work done and seals.
"""

from contextlib import ExitStack

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.shards import Shard
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import require_bpy
from phd_exp.rendering.errors import writing
from phd_exp.rendering.locks import held, held_if_free
from phd_exp.rendering.progress import announce
from phd_exp.rendering.sealing import Wanted, begin, known_samples, missing, seal
from phd_exp.rendering.workers import render_missing


def render_shard(
    folder: DatasetFolder,
    spec: DatasetSpec,
    n_train: int,
    n_test: int,
    shard: Shard,
    workers: int | None = None,
    cores: int | None = None,
) -> bool:
    """Render what is missing of one share, and seal the folder if that was the last; whether all of it is there.

    Shares of different counts may overlap; work done by one is not done again by another that starts later.

    Raises:
        DatasetError: the folder holds another data set, or a broken one.
        RenderError: bpy is missing, a worker died, the folder cannot be written.
    """
    if not any(folder.missing(spec, n_train, n_test).values()):
        return True
    require_bpy()
    wanted: Wanted = {"train": n_train, "test": n_test}
    with writing(folder.root):
        folder.cache.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            _enter(stack, folder, shard)
            with held(folder.cache / "begin.lock", waiting=f"{folder.root}: waiting for the manifest"):
                folder.missing(spec, n_train, n_test)  # refuses another data set, begun a moment ago
                begin(folder, spec)
            if not render_missing(folder, spec, wanted, known_samples(folder), workers, shard, cores):
                announce(f"{folder.root}: nothing left to render in shard {shard}")
        return _seal_if_last(folder, wanted, shard)


def _enter(stack: ExitStack, folder: DatasetFolder, shard: Shard) -> None:
    whole = f"{folder.root}: another process renders all of it; shard {shard} waits for it to finish"
    twin = f"{folder.root}: another process renders shard {shard}; waiting for it to finish"
    stack.enter_context(held(folder.render_lock, shared=True, waiting=whole))
    stack.enter_context(held(folder.cache / f"shard-{shard.slug}.lock", waiting=twin))


def _seal_if_last(folder: DatasetFolder, wanted: Wanted, shard: Shard) -> bool:
    with held_if_free(folder.render_lock) as alone:
        known = known_samples(folder)
        left = missing(known, wanted)
        if alone and not left:
            seal(folder, known)
            announce(f"{folder.root}: shard {shard} was the last; the data set is sealed")
            return True
    if left:
        announce(f"{folder.root}: shard {shard} is done; {left} samples of other shards are missing")
    else:
        announce(f"{folder.root}: shard {shard} is done; another process is still at work here, and seals")
    return False
