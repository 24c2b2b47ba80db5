"""A layer of a dense network for rows side by side, compiled by numba, with its sums kept in registers.

A loop over rows within one over inputs, as numba compiles it, reads and writes every sum for every few inputs; that is
2.5 times slower. So the inner loop is written for LLVM, in vectors of `STRIP` rows, which it puts into registers of
the width that the processor has. Each sum has the same operations in the same order whatever the other rows are.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, codegen, types
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from rare_envs.compilation import compiled_fused

_CODE: Any = codegen
UNITS_AT_ONCE, STRIP = (8, 32) if "+avx512f" in _CODE.get_host_cpu_features() else (4, 16)
"""Outputs, and rows of each, that are computed at once: half of the 32 registers of AVX-512, whose additions overlap,
or of the 16 of AVX2. Four outputs in place of eight made highways a sixth slower with AVX-512; AVX2 with twice as many
rows has no register left, and takes half as long again."""
_BUILD: Any = cgutils
_ARRAYS: Any = arrayobj
_VECTOR = ir.VectorType(ir.FloatType(), STRIP)
_UNDEFINED = ir.Constant(_VECTOR, ir.Undefined)
_FIRST = ir.Constant(ir.VectorType(ir.IntType(32), STRIP), [0] * STRIP)
_FUSED = ("contract",)
"""Products that are added are not rounded before, where the processor can do so."""


@compiled_fused
def apply_layer(
    weight: NDArray[np.float32], bias: NDArray[np.float32], before: NDArray[np.float32], after: NDArray[np.float32]
) -> None:
    """Write a layer's outputs.

    Args:
        weight: Shape (outputs, inputs), contiguous as all; outputs are a multiple of `UNITS_AT_ONCE`.
        bias: Shape (outputs,).
        before: Inputs, shape (at least inputs, lanes); lanes are a multiple of `STRIP`.
        after: Outputs, shape (at least outputs, lanes), written to.
    """
    for lane in range(0, before.shape[1], STRIP):
        for output in range(0, weight.shape[0], UNITS_AT_ONCE):
            _write_strip(weight, bias, before, after, output, lane)


def _type_strip(
    _: Any, weight: Any, bias: Any, before: Any, after: Any, output: Any, lane: Any
) -> tuple[Any, Any]:  # types, not values
    """Return the signature of `_write_strip` and what generates it."""
    return types.void(weight, bias, before, after, types.intp, types.intp), _generate_strip


_write_strip: Any = intrinsic(_type_strip)
"""Writes `UNITS_AT_ONCE` outputs from number `output` on, of `STRIP` rows from number `lane` on."""


def _generate_strip(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Generate: sums = bias; for each input: sums += weight * value; after = sums."""
    *given, output, lane = arguments
    weight, bias, before, after = (
        _ARRAYS.make_array(kind)(context, builder, value) for kind, value in zip(signature.args, given, strict=False)
    )
    inputs, lanes = (_BUILD.unpack_tuple(builder, array.shape)[1] for array in (weight, before))
    units = [builder.add(output, output.type(number)) for number in range(UNITS_AT_ONCE)]

    def spread(array: Any, place: Any) -> Any:
        """Return a number of an array in all places of a vector."""
        number = builder.load(builder.gep(array.data, [place]))
        return builder.shuffle_vector(builder.insert_element(_UNDEFINED, number, ir.IntType(32)(0)), _UNDEFINED, _FIRST)

    def strip_of(array: Any, row: Any) -> Any:
        """Return where the strip's part of a row of an array is."""
        place = builder.gep(array.data, [builder.add(builder.mul(row, lanes), lane)])
        return builder.bitcast(place, _VECTOR.as_pointer())

    sums = [_BUILD.alloca_once_value(builder, spread(bias, unit)) for unit in units]
    rows = [builder.mul(unit, inputs) for unit in units]
    with _BUILD.for_range(builder, inputs) as loop:
        value = builder.load(strip_of(before, loop.index), align=4)
        for total, row in zip(sums, rows, strict=True):
            product = builder.fmul(spread(weight, builder.add(row, loop.index)), value, flags=_FUSED)
            builder.store(builder.fadd(builder.load(total), product, flags=_FUSED), total)
    for total, unit in zip(sums, units, strict=True):
        builder.store(builder.load(total), strip_of(after, unit), align=4)
    return context.get_dummy_value()
