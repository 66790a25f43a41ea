"""The blocks of torchvision's ResNets, imported without torch's compiler.

torchvision imports the compiler for one function that pools regions, which no network here does. The compiler takes
as long to import as torch itself.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

COMPILER = "torch._dynamo"


@contextmanager
def _without_compiler() -> Iterator[None]:
    """In the body, the compiler is a module with the function that torchvision takes from it, which imports it."""

    def is_compile_supported(device: Any) -> bool:
        from torch._dynamo.utils import is_compile_supported as theirs

        return theirs(device)

    if COMPILER in sys.modules:
        yield
        return
    package, utils = ModuleType(COMPILER), ModuleType(f"{COMPILER}.utils")
    utils.is_compile_supported = is_compile_supported  # type: ignore[attr-defined]
    stand_ins = {COMPILER: package, utils.__name__: utils}
    sys.modules |= stand_ins
    try:
        yield
    finally:
        for name in stand_ins:
            del sys.modules[name]


try:
    with _without_compiler():
        from torchvision.models.resnet import BasicBlock, Bottleneck, ResNet
except ImportError:  # another version of torchvision takes more from the compiler
    from torchvision.models.resnet import BasicBlock, Bottleneck, ResNet

__all__ = ["BasicBlock", "Bottleneck", "ResNet"]
