"""A Piper voice's model (VITS, in ONNX) cut in two: from sounds to frames, and from frames to samples.

The second half looks at no more than some frames around each sample, so that it can be run piece by piece, and the
first tells for how many frames each sound lasts, which the whole keeps to itself: when each word is heard.

Pure: bytes in, bytes out. It reads as much of ONNX's encoding (protobuf) as that takes, by the field numbers of
`onnx.proto`. A model is a stranger's file, which a library in C will read: what is not understood, or refers to
anything outside of the file, is refused here, and nothing is handed on but what was looked at.
"""

from __future__ import annotations

import itertools

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    Buffer = bytes | memoryview
    #: a field of a message: its number, its kind (one of the next three), and its value, an integer's as it is encoded
    Field = tuple[int, int, Buffer]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
#: Fields of a model, of an entry of its list of operators, of a graph, a node, an attribute and a tensor.
_IR_VERSION, _GRAPH, _OPERATORS, _FUNCTIONS = 1, 7, 8, 25
_DOMAIN = 1
_NODE, _GRAPH_NAME, _INITIALIZER, _INPUT, _OUTPUT, _SPARSE_INITIALIZER = 1, 2, 5, 11, 12, 15
_NODE_INPUT, _NODE_OUTPUT, _OPERATOR, _ATTRIBUTE, _NODE_DOMAIN = 1, 2, 4, 5, 7
_TENSOR, _SUBGRAPH, _TENSORS, _SUBGRAPHS, _SPARSE_TENSOR, _SPARSE_TENSORS = 5, 6, 10, 11, 22, 23
_TENSOR_NAME, _EXTERNAL_DATA, _DATA_LOCATION = 8, 13, 14

#: The operators that ONNX itself defines go by one of these; any other is somebody's own code.
_STANDARD = ("", "ai.onnx")
#: The first layer of the second half, by its weights: the name that it has in each of Piper's models.
_CUT = "dec.conv_pre.weight"
#: What rounds the durations up to whole frames; there is one in the first half.
_ROUNDING = "Ceil"
#: What makes something else each time is no constant, though it may need nothing.
_RANDOM = "Random"
#: The type of a value: floats, in any shape.
_FLOATS = b"\x12\x04\x0a\x02\x08\x01"
#: Graphs inside of graphs that are looked at: Piper's have none, and PyTorch writes one for a condition.
_DEEPEST = 4
#: Fields that are read of a model, 300 bytes and a microsecond or three each: Piper's have 30,000. And the characters
#: of a name: theirs have 52 at most.
_MOST_FIELDS, _LONGEST_NAME = 300_000, 1000
#: Bits of the longest integer.
_LONGEST = 64


class NotCut(Exception):
    """The model is none of Piper's, or none that is to be run: the text says why, for behind the file's name."""


@frozen
class Halves:
    """Both halves, each a model of its own, in parts: its bytes are these, one after the other.

    The weights, which are nearly all of it, are not copied: they are the whole's.
    """

    #: has the whole's inputs; its outputs are what the decoder needs, and last the frames of each sound
    encoder: tuple[Buffer, ...]
    #: its inputs are the encoder's outputs but for the last; its output is the whole's
    decoder: tuple[Buffer, ...]


def halves(model: Buffer) -> Halves:
    """Cut a model; NotCut."""
    reader = _Reader()
    fields = reader.fields(memoryview(model))
    graphs = [value for number, kind, value in fields if (number, kind) == (_GRAPH, _BYTES)]
    if len(graphs) != 1:
        raise NotCut("is no ONNX model")
    if any(number == _FUNCTIONS for number, _, _ in fields):
        raise NotCut("has operators of its own")
    graph = _Graph(reader, graphs[0])
    decoder = graph.behind(_CUT)
    if not decoder:
        raise NotCut(f"is none of Piper's models: it has no {_CUT}")
    constants = graph.constants()
    takes = {name for each in decoder for name in each.inputs}
    before = {name for each in graph.nodes for name in each.outputs} - {
        name for each in decoder for name in each.outputs
    }
    handed = sorted((takes & before) - constants)
    first = graph.needed(handed)
    durations = [each.outputs[0] for each in first if each.operator == _ROUNDING and each.outputs]
    if not handed or len(durations) != 1:
        raise NotCut("is none of Piper's models: it does not tell how long each sound lasts")
    second = [*graph.needed(takes & constants), *decoder]
    head = [each for each in fields if _is_head(reader, each)]
    ends = [(_OUTPUT, _BYTES, _value(name)) for name in [*handed, *durations]]
    begins = [(_INPUT, _BYTES, _value(name)) for name in handed]
    return Halves(
        _model(head, [*graph.part(first), *graph.inputs, *ends]),
        _model(head, [*graph.part(second), *begins, *graph.outputs]),
    )


class _Reader:
    """Reads messages, of one model and no more of them than a model of Piper's may have."""

    def __init__(self) -> None:
        self._left = _MOST_FIELDS

    def fields(self, raw: Buffer) -> list[Field]:
        """Return the fields of a message; NotCut where it isn't one."""
        found = list(itertools.islice(_fields(raw), self._left + 1))
        self._left -= len(found)
        if self._left < 0:
            raise NotCut("is none of Piper's models: it has too many parts")
        return found


class _Node:
    """An operation: what it needs, what it makes; what graphs inside of it need, it needs, too."""

    def __init__(self, reader: _Reader, raw: Buffer, depth: int) -> None:
        fields = reader.fields(raw)
        self.raw = raw
        self.inputs = _names(fields, _NODE_INPUT)
        self.outputs = _names(fields, _NODE_OUTPUT)
        self.operator = "".join(_names(fields, _OPERATOR))
        domain = "".join(_names(fields, _NODE_DOMAIN))
        if domain not in _STANDARD:
            raise NotCut(f"has operators of its own ({domain[:40]}:{self.operator[:40]})")
        for attribute in _messages(fields, _ATTRIBUTE):
            parts = reader.fields(attribute)
            if any(number in {_SPARSE_TENSOR, _SPARSE_TENSORS} for number, _, _ in parts):
                raise NotCut("has sparse weights, which none of Piper's has")
            for tensor in (*_messages(parts, _TENSOR), *_messages(parts, _TENSORS)):
                _tensor_name(reader, tensor)
            for inner in (*_messages(parts, _SUBGRAPH), *_messages(parts, _SUBGRAPHS)):
                self.inputs += [name for each in _Graph(reader, inner, depth + 1).nodes for name in each.inputs]


class _Graph:
    """The nodes of a graph, in the order in which they run, with their weights."""

    def __init__(self, reader: _Reader, raw: Buffer, depth: int = 0) -> None:
        if depth > _DEEPEST:
            raise NotCut(f"has graphs inside of graphs, more than {_DEEPEST} deep")
        fields = reader.fields(raw)
        if any(number == _SPARSE_INITIALIZER for number, _, _ in fields):
            raise NotCut("has sparse weights, which none of Piper's has")
        self.nodes = [_Node(reader, each, depth) for each in _messages(fields, _NODE)]
        self._weights = {_tensor_name(reader, each): each for each in _messages(fields, _INITIALIZER)}
        self.inputs = [each for each in fields if each[:2] == (_INPUT, _BYTES)]
        self.outputs = [each for each in fields if each[:2] == (_OUTPUT, _BYTES)]

    def behind(self, weight: str) -> list[_Node]:
        """Return the nodes that take these weights, or what was made by one that does."""
        made = {weight}
        found = []
        for node in self.nodes:
            if not made.isdisjoint(node.inputs):
                made.update(node.outputs)
                found.append(node)
        return found

    def constants(self) -> set[str]:
        """Return the names of what is always the same: both halves may have it."""
        names = {*self._weights, ""}
        for node in self.nodes:
            if names.issuperset(node.inputs) and not node.operator.startswith(_RANDOM):
                names.update(node.outputs)
        return names

    def needed(self, wanted: Iterable[str]) -> list[_Node]:
        """Return the nodes without which what is wanted is not made."""
        names = {*wanted}
        found = []
        for node in reversed(self.nodes):
            if not names.isdisjoint(node.outputs):
                names.update(node.inputs)
                found.append(node)
        return found[::-1]

    def part(self, nodes: list[_Node]) -> list[Field]:
        """Return these nodes, with the weights that they need, as the fields of a graph without ends."""
        names = {name for each in nodes for name in each.inputs}
        kept = [(_INITIALIZER, _BYTES, each) for name, each in self._weights.items() if name in names]
        return [*((_NODE, _BYTES, each.raw) for each in nodes), (_GRAPH_NAME, _BYTES, b"half"), *kept]


def _is_head(reader: _Reader, field: Field) -> bool:
    """Tell whether a field of the model belongs to both halves: what version it is of, of which standard operators."""
    number, kind, value = field
    if (number, kind) == (_OPERATORS, _BYTES):
        return "".join(_names(reader.fields(value), _DOMAIN)) in _STANDARD
    return number == _IR_VERSION


def _tensor_name(reader: _Reader, raw: Buffer) -> str:
    """Return the name of a tensor; NotCut if its numbers are not in it."""
    fields = reader.fields(raw)
    outside = (value for number, _, value in fields if number in {_EXTERNAL_DATA, _DATA_LOCATION})
    if any(bytes(value) != b"\0" for value in outside):
        raise NotCut("has its weights in another file")
    return "".join(_names(fields, _TENSOR_NAME))


def _messages(fields: Iterable[Field], wanted: int) -> list[Buffer]:
    return [value for number, kind, value in fields if (number, kind) == (wanted, _BYTES)]


def _names(fields: Iterable[Field], wanted: int) -> list[str]:
    found = _messages(fields, wanted)
    if any(len(value) > _LONGEST_NAME for value in found):
        raise NotCut("is none of Piper's models: it has names that are too long")
    try:
        return [bytes(value).decode() for value in found]
    except UnicodeDecodeError as error:
        raise NotCut("is no ONNX model: it has names that are no text") from error


def _fields(raw: Buffer) -> Iterator[Field]:
    """Yield the fields of a message; NotCut where it isn't one."""
    at, end = 0, len(raw)
    while at < end:
        key, at = _integer(raw, at)
        number, kind = key >> 3, key & 7
        if kind == _BYTES:
            size, at = _integer(raw, at)
        elif kind == _VARINT:
            size = _integer(raw, at)[1] - at
        elif kind in {_FIXED32, _FIXED64}:
            size = 4 if kind == _FIXED32 else 8
        else:
            raise NotCut("is no ONNX model")
        if size > end - at:
            raise NotCut("is cut short, or no ONNX model")
        yield number, kind, raw[at : at + size]
        at += size


def _integer(raw: Buffer, at: int) -> tuple[int, int]:
    """Return the integer that is encoded there, and where it ends."""
    result = shift = 0
    while at < len(raw) and shift < _LONGEST:
        byte = raw[at]
        at += 1
        result |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return result, at
    raise NotCut("is cut short, or no ONNX model")


def _encoded(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _model(head: list[Field], graph: list[Field]) -> tuple[Buffer, ...]:
    """Return a model, in parts."""
    parts = list(_written(graph))
    key = _encoded(_GRAPH << 3 | _BYTES) + _encoded(sum(map(len, parts)))
    return (*_written(head), key, *parts)


def _written(fields: Iterable[Field]) -> Iterator[Buffer]:
    for number, kind, value in fields:
        yield _encoded(number << 3 | kind)
        if kind == _BYTES:
            yield _encoded(len(value))
        yield value


def _value(name: str) -> bytes:
    """Return the description of an input or output: its name, and that it is of floats."""
    return b"".join(_written([(1, _BYTES, name.encode())])) + _FLOATS
