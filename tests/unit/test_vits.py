"""Splitting a Piper model in two, and refusing other models and unsafe ones."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.child.synthesizers import vits
from talkcli.engine.child.synthesizers.vits import NotSplit, split_model
from tests.support import tiny_voice
from tests.support.tiny_voice import field, node, tensor, weight

if TYPE_CHECKING:
    from collections.abc import Callable

MODEL = tiny_voice.model()
#: Field numbers of a graph and of a tensor in an attribute of a node.
_GRAPH, _TENSOR = 6, 5
CONSTANT = field(1, "value") + field(_TENSOR, tensor("t", [1], 1, more=field(14, 1))) + field(20, 4)


def _halves(model: bytes) -> tuple[bytes, bytes]:
    """Return the encoder and the decoder of a model."""
    encoder, decoder = split_model(model)
    return b"".join(encoder), b"".join(decoder)


def _inside(graph: bytes, deep: int) -> bytes:
    """Return a node that contains this many nested graphs."""
    for _ in range(deep):
        graph = node("If", ["input"], "unused", field(1, "then_branch") + field(_GRAPH, graph) + field(20, 5))
    return graph


def test_the_encoder_has_the_inputs_and_the_decoder_the_output() -> None:
    encoder, decoder = _halves(MODEL)
    for name in ("input_lengths", "scales", "frames_of", "Ceil"):
        assert name.encode() in encoder
        assert name.encode() not in decoder
    for name in ("dec.conv_pre.weight", "ConvTranspose", "output", "Identity"):
        assert name.encode() in decoder
    assert b"dec.conv_pre.weight" not in encoder
    assert len(encoder) + len(decoder) < 1.2 * len(MODEL)


def test_parts_that_belong_to_neither_half_are_left_out() -> None:
    """The library that reads the model must only get parts that were checked."""
    encoder, decoder = _halves(
        tiny_voice.model(fields=field(14, field(1, "note") + field(2, "metadata")) + field(20, b"training"))
    )
    for half in (encoder, decoder):
        assert b"metadata" not in half
        assert b"training" not in half


def test_a_nested_graph_keeps_its_weights() -> None:
    """Only the nested graph uses this weight."""
    inner = node("Identity", ["only_inside"], "then_out")
    condition = node("If", ["frames"], "more", field(1, "then_branch") + field(_GRAPH, inner) + field(20, 5))
    after = node("Add", ["output", "more"], "last")
    encoder, _ = _halves(tiny_voice.model(nodes=condition + after, weights=weight("only_inside", [1.0], 1)))
    assert tensor("only_inside", [1.0], 1) in encoder


@pytest.mark.parametrize(
    ("model", "why"),
    [
        (b"", "is not an ONNX model"),
        (b"RIFF\x10\x00\x00\x00WAVEfmt ", "ONNX model"),
        (b"<!DOCTYPE html><html>", "ONNX model"),
        (MODEL[:-100], "truncated"),
        (MODEL[: len(MODEL) // 2], "truncated"),
        (MODEL + MODEL, "is not an ONNX model"),
        (b"\xff" * 100, "truncated"),
        (tiny_voice.model(cut="other.weight"), "is not a Piper model: it has no dec.conv_pre.weight"),
        (tiny_voice.model(nodes=node("Ceil", ["floats"], "frames")), "does not report the duration of each phoneme"),
        (tiny_voice.model(nodes=node("Format", ["input"], "x", domain="evil")), "custom operators (evil:Format)"),
        (tiny_voice.model(nodes=node("Gelu", ["input"], "x", domain="com.microsoft")), "custom operators"),
        (tiny_voice.model(fields=field(25, field(1, "mine"))), "has custom operators"),
        (tiny_voice.model(weights=weight("w", [1], 1, more=field(13, b"\x0a\x08location"))), "in another file"),
        (tiny_voice.model(weights=weight("w", [1], 1, more=field(14, 1))), "in another file"),
        (tiny_voice.model(weights=field(15, b"")), "sparse"),
        (tiny_voice.model(nodes=_inside(node("Evil", [], "x", domain="evil"), 2)), "custom operators (evil:Evil)"),
        (tiny_voice.model(nodes=_inside(weight("w", [1], 1, more=field(14, 1)), 2)), "in another file"),
        (tiny_voice.model(nodes=_inside(b"", 50)), "graphs that are nested"),
        (tiny_voice.model(nodes=node("Add", ["n" * 1001], "x")), "is not a Piper model: it has names that are"),
        (tiny_voice.model(nodes=node("Constant", [], "x", CONSTANT)), "in another file"),
    ],
)
def test_an_unsafe_or_invalid_model_is_refused_with_a_reason(model: bytes, why: str) -> None:
    with pytest.raises(NotSplit, match=why.replace("(", r"\(").replace(")", r"\)").replace(".", r"\.")):
        _halves(model)


@pytest.mark.parametrize(
    "where",
    [
        lambda many: tiny_voice.model(fields=many),
        lambda many: tiny_voice.model(nodes=many),
        lambda many: tiny_voice.model(nodes=node("Add", [], "x", many)),
        lambda many: tiny_voice.model(nodes=node("Add", [], "x", field(5, many))),
        lambda many: tiny_voice.model(weights=weight("w", [1], 1, more=many)),
        lambda many: tiny_voice.model(fields=field(8, many)),
        lambda many: tiny_voice.model(nodes=field(1, b"") * (len(many) // 2)),
    ],
    ids=["model", "graph", "attribute", "tensor", "weight", "operators", "nodes"],
)
def test_a_model_with_too_many_parts_is_refused_wherever_they_are(
    monkeypatch: pytest.MonkeyPatch, where: Callable[[bytes], bytes]
) -> None:
    """The largest file could have 100 million parts, which would take minutes and 30 GB of memory."""
    assert vits._MAX_FIELDS == 300_000
    monkeypatch.setattr(vits, "_MAX_FIELDS", 3_000)
    _halves(where(field(3, 1) * 100))
    with pytest.raises(NotSplit, match="it has too many parts"):
        _halves(where(field(3, 1) * 3_000))


@given(st.integers(0, len(MODEL) - 1), st.binary(min_size=1, max_size=8))
def test_a_corrupt_model_is_split_or_refused(place: int, written: bytes) -> None:
    broken = MODEL[:place] + written + MODEL[place + len(written) :]
    with contextlib.suppress(NotSplit):
        encoder, decoder = _halves(broken)
        assert encoder
        assert decoder
