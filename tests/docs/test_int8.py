"""The guide's example of a network in int8 quantises all convolutions but the first and the last two."""

import logging
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.docs.pages import DOCS

onnx = pytest.importorskip("onnx", reason="needs `pip install 'phd_exp[export]'`")
BLOCKS = re.findall(r"(?:^(?: {4}.*)?\n)+", (DOCS / "guides" / "predict.md").read_text(), re.MULTILINE)
(EXAMPLE,) = (textwrap.dedent(block) for block in BLOCKS if "quantize_static" in block)


class Network(nn.Module):
    """Five convolutions of images, with the inputs of an exported network."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(*(nn.Conv2d(3, 3, 3) for _ in range(5)))

    def forward(self, image: torch.Tensor, f: torch.Tensor) -> torch.Tensor:
        return self.convolutions(image.permute(0, 3, 1, 2).float()).mean((1, 2, 3)) * f


@pytest.mark.filterwarnings("ignore")  # of torch about the way it exports
def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    images, f = np.random.default_rng(0).integers(0, 256, (8, 16, 16, 3), np.uint8), np.ones(8, np.float32)
    given = torch.from_numpy(images), torch.from_numpy(f)
    torch.onnx.export(Network().float().eval(), given, "network.onnx", input_names=["image", "f"], dynamo=True)
    logging.disable(logging.WARNING)  # onnxruntime advises to prepare the graph
    exec(EXAMPLE, {"images": images, "f": f})
    logging.disable(logging.NOTSET)
    graph = onnx.load("int8.onnx").graph
    makers = {output: node.op_type for node in graph.node for output in node.output}
    assert [makers.get(node.input[1]) == "DequantizeLinear" for node in graph.node if node.op_type == "Conv"] == [
        False, True, True, False, False,
    ]  # fmt: skip
