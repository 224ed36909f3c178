"""Records of constant length: what numpy lays out is what protobuf reads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from trainlog.mcap.codec import Value, gather, layout, varint
from trainlog.mcap.records import MESSAGE

FORM = layout(3, [b"\x09", Value("a", "<f8"), b"\x12\x10", Value("b", "<f8", 2)])


@pytest.mark.parametrize(
    "offsets",
    [
        [1],
        [-1],
        [2**63],
        [2**64 - 1],
        [0, 0],
        [0, 10**6],
    ],
)
def test_offsets_that_lead_nowhere_are_refused(offsets: list[int]) -> None:
    kind = np.int64 if min(offsets) < 0 else np.uint64
    assert gather(FORM.template, np.array(offsets, dtype=kind), FORM) is None
    assert gather(FORM.template[:-1], np.array([0]), FORM) is None


def test_every_constant_byte_is_compared() -> None:
    variable = {
        *range(11, MESSAGE.size),
        *range(MESSAGE.size + 1, MESSAGE.size + 9),
        *range(MESSAGE.size + 11, FORM.size),
    }
    for at in range(FORM.size):
        changed = bytearray(FORM.template)
        changed[at] ^= 0x80
        found = gather(bytes(changed), np.array([0]), FORM)
        assert (found is not None) == (at in variable)


@given(st.integers(0, 2**64 - 1))
def test_varints(number: int) -> None:
    value = 0
    for place, byte in enumerate(varint(number)):
        value |= (byte & 0x7F) << 7 * place
    assert value == number
    assert len(varint(number)) == max(1, -(-number.bit_length() // 7))
