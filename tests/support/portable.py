"""What an exported graph may contain so that other runtimes take it."""

from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

OPERATORS = """
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Cast CastLike Ceil Celu
Clip Concat Constant ConstantOfShape Conv ConvTranspose Cos Cosh CumSum DeformConv DepthToSpace DequantizeLinear Div
Dropout Einsum Elu Equal Erf Exp Expand EyeLike Flatten Floor Gather GatherElements GatherND Gelu Gemm
GlobalAveragePool GlobalLpPool GlobalMaxPool Greater GreaterOrEqual GridSample GroupNormalization GRU HardSigmoid
HardSwish Hardmax Identity If ImageScaler InstanceNormalization IsInf IsNaN LayerNormalization LeakyRelu Less
LessOrEqual Log LogSoftmax Loop LRN LSTM LpNormalization LpPool MatMul Max MaxPool Mean MeanVarianceNormalization
Min Mish Mod Mul Neg NonMaxSuppression NonZero Not OneHot Or Pad ParametricSoftplus Pow PRelu QuantizeLinear
RandomNormal RandomNormalLike RandomUniform RandomUniformLike Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum
ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize
ReverseSequence RNN RoiAlign Round ScaledTanh Scan Scatter ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign
Sin Sinh Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile
TopK Transpose Trilu Unsqueeze Upsample Where Xor
"""
"""The operators with Y in the table of TensorRT 10.0, which takes opsets 9 to 20.

Source: https://github.com/onnx/onnx-tensorrt/blob/96e7811/docs/operators.md
"""
TENSORRT = frozenset(OPERATORS.split())
AXES_INPUT = {"Pad": 3, "Slice": 3, "Squeeze": 1, "Unsqueeze": 1, "CumSum": 1}
"""Operator, apart from Reduce..., whose axes TensorRT needs as constants -> the number of its input of axes."""


class NoChoiceOfTruths(TorchDispatchMode):
    """Fails at a `where` between booleans, which onnxruntime cannot compute; an export of a minute shows the same."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        assert func is not torch.ops.aten.where.self or found.dtype != torch.bool
        return found


def require_portable(model: Any) -> None:
    """Fails unless operators are TensorRT's, of opset 18, format 8 and constant axes, and no tensor is float64."""
    from onnx import TensorProto, checker

    assert model.ir_version == 8
    checker.check_model(model)
    ((domain, version),) = [(opset.domain, opset.version) for opset in model.opset_import]
    assert (domain, version) == ("", 18)
    assert {node.op_type for node in model.graph.node} <= TENSORRT
    constants = {tensor.name for tensor in model.graph.initializer}
    for node in model.graph.node:
        place = 1 if node.op_type.startswith("Reduce") else AXES_INPUT.get(node.op_type)
        if place is not None and len(node.input) > place and node.input[place]:
            assert node.input[place] in constants, node
    values = (*model.graph.value_info, *model.graph.input, *model.graph.output)
    found = {value.type.tensor_type.elem_type for value in values}
    found |= {tensor.data_type for tensor in model.graph.initializer}
    found |= {attribute.i for node in model.graph.node for attribute in node.attribute if attribute.name == "to"}
    produced = {name for node in model.graph.node for name in node.output if name}
    assert produced <= {value.name for value in values}, "the type of every value is stated"
    assert TensorProto.DOUBLE not in found
    assert TensorProto.FLOAT in found


def openvino_outputs(content: bytes, given: dict) -> list:
    """The outputs of a graph in OpenVINO on the CPU, computed in float32; skips the test where it is missing."""
    openvino = pytest.importorskip("openvino", reason="needs `pip install openvino`")
    core = openvino.Core()
    compiled = core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = compiled(given)
    return [found[output] for output in compiled.outputs]
