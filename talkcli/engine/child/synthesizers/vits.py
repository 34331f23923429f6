"""Functions to split the model of a Piper voice into an encoder and a decoder.

The encoder turns phoneme ids into frames, and the decoder turns frames into samples. Each sample depends only on nearby
frames, so the decoder can process a few frames at a time. The encoder also outputs how many frames each phoneme id
takes, which is used to calculate the times of words. The whole model doesn't output this.

Models come from strangers, and onnxruntime reads them with C++ code. A model is therefore rejected if this module
doesn't understand it, or if it refers to other files. The halves contain only fields that have been checked.

The module is pure. It reads only the fields that it needs from the file, which is encoded as a protobuf message. The
field numbers are those of `onnx.proto`.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    Buffer = bytes | memoryview
    #: a field of a message: its number, its wire type (one of the four below), and its value. Integers stay encoded.
    Field = tuple[int, int, Buffer]
    #: the parts of an ONNX file that contains half of a model. The weights are not copied.
    ModelHalf = tuple[Buffer, ...]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
#: The field numbers of a model, an operator set, a graph, a node, an attribute and a tensor.
_IR_VERSION, _GRAPH, _OPERATOR_SETS, _MODEL_FUNCTIONS = 1, 7, 8, 25
_DOMAIN = 1
_NODE, _GRAPH_NAME, _INITIALIZER, _INPUT, _OUTPUT, _SPARSE_INITIALIZER = 1, 2, 5, 11, 12, 15
_NODE_INPUT, _NODE_OUTPUT, _OPERATOR, _ATTRIBUTE, _NODE_DOMAIN = 1, 2, 4, 5, 7
_TENSOR, _SUBGRAPH, _TENSORS, _SUBGRAPHS, _SPARSE_TENSOR, _SPARSE_TENSORS = 5, 6, 10, 11, 22, 23
_TENSOR_NAME, _EXTERNAL_DATA, _DATA_LOCATION = 8, 13, 14

#: The domains of the standard ONNX operators. Operators from other domains are rejected, because they could run foreign
#: code.
_STANDARD_DOMAINS = ("", "ai.onnx")
#: The weights of the decoder's first layer have this name in all of Piper's models.
_DECODER_WEIGHTS = "dec.conv_pre.weight"
#: The operator that rounds durations up to whole frames. It occurs exactly once in an encoder.
_ROUNDING_OPERATOR = "Ceil"
#: The names of random operators begin with this prefix. Their results are not constant.
_RANDOM_PREFIX = "Random"
#: The encoded type of a tensor of floats with any shape.
_FLOAT_TYPE = b"\x12\x04\x0a\x02\x08\x01"
#: How deeply graphs may be nested. Piper's models have no nested graphs, but PyTorch writes one for a condition.
_MAX_NESTED_GRAPHS = 4
#: The maximum number of fields in a model. Each field takes 300 bytes of memory, and 1 to 3 microseconds to read.
#: Piper's models have 30,000 fields.
_MAX_FIELDS = 300_000
#: The maximum length of a name. The longest name in Piper's models has 52 characters.
_MAX_NAME_BYTES = 1000


class NotSplit(Exception):
    """Raised if a model is unsafe or isn't a Piper model.

    The message gives the reason without the file's name.
    """


def split_model(model: Buffer) -> tuple[ModelHalf, ModelHalf]:
    """Split the content of a Piper model into its encoder and its decoder.

    The encoder has the inputs of the whole model. It outputs the decoder's inputs, and then the number of frames of
    each phoneme id. The decoder has the output of the whole model.

    Raises:
        NotSplit: The model is unsafe, or not one of Piper's.
    """
    reader = _Reader()
    fields = reader.fields(memoryview(model))
    graphs = _messages(fields, _GRAPH)
    if len(graphs) != 1:
        raise NotSplit("is not an ONNX model")
    if any(number == _MODEL_FUNCTIONS for number, _, _ in fields):
        raise NotSplit("has custom operators")
    graph = _Graph(reader, graphs[0])
    decoder = graph.nodes_after(_DECODER_WEIGHTS)
    if not decoder:
        raise NotSplit(f"is not a Piper model: it has no {_DECODER_WEIGHTS}")
    constants = graph.constants()
    needed = {name for each in decoder for name in each.inputs}
    made_before = {name for each in graph.nodes for name in each.outputs}
    made_before -= {name for each in decoder for name in each.outputs}
    passed = sorted((needed & made_before) - constants)
    encoder = graph.nodes_for(passed)
    durations = [each.outputs[0] for each in encoder if each.operator == _ROUNDING_OPERATOR and each.outputs]
    if not passed or len(durations) != 1:
        raise NotSplit("is not a Piper model: it does not report the duration of each phoneme")
    decoder = [*graph.nodes_for(needed & constants), *decoder]
    head = [each for each in fields if _is_shared(reader, each)]
    outputs = [(_OUTPUT, _BYTES, _encode_float_value(name)) for name in [*passed, *durations]]
    inputs = [(_INPUT, _BYTES, _encode_float_value(name)) for name in passed]
    encoder_fields = [*graph.fields_of(encoder), *graph.inputs, *outputs]
    decoder_fields = [*graph.fields_of(decoder), *inputs, *graph.outputs]
    return _encode_model(head, encoder_fields), _encode_model(head, decoder_fields)


class _Reader:
    """Reads the protobuf messages of one model."""

    def __init__(self) -> None:
        self._fields_left = _MAX_FIELDS

    def fields(self, raw: Buffer) -> list[Field]:
        """Parse a protobuf message. Return its fields.

        Raise NotSplit if the message is invalid.
        """
        found = []
        at, end = 0, len(raw)
        while at < end:
            key, at = _parse_integer(raw, at)
            number, kind = key >> 3, key & 7
            if kind == _BYTES:
                size, at = _parse_integer(raw, at)
            elif kind == _VARINT:
                size = _parse_integer(raw, at)[1] - at
            elif kind in {_FIXED32, _FIXED64}:
                size = 4 if kind == _FIXED32 else 8
            else:
                raise NotSplit("is not an ONNX model")
            if size > end - at:
                raise NotSplit("is truncated, or not an ONNX model")
            self._fields_left -= 1
            if self._fields_left < 0:
                raise NotSplit("is not a Piper model: it has too many parts")
            found.append((number, kind, raw[at : at + size]))
            at += size
        return found


class _Node:
    """An operation in a model's graph. Its inputs include those of nested graphs."""

    def __init__(self, reader: _Reader, raw: Buffer, depth: int) -> None:
        fields = reader.fields(raw)
        self.raw = raw
        self.inputs = _names(fields, _NODE_INPUT)
        self.outputs = _names(fields, _NODE_OUTPUT)
        self.operator = "".join(_names(fields, _OPERATOR))
        domain = "".join(_names(fields, _NODE_DOMAIN))
        if domain not in _STANDARD_DOMAINS:
            raise NotSplit(f"has custom operators ({domain[:40]}:{self.operator[:40]})")
        for attribute in _messages(fields, _ATTRIBUTE):
            parts = reader.fields(attribute)
            if any(number in {_SPARSE_TENSOR, _SPARSE_TENSORS} for number, _, _ in parts):
                raise NotSplit("has sparse weights, unlike any Piper model")
            for tensor in (*_messages(parts, _TENSOR), *_messages(parts, _TENSORS)):
                _checked_tensor_name(reader, tensor)
            for inner in (*_messages(parts, _SUBGRAPH), *_messages(parts, _SUBGRAPHS)):
                self.inputs += [name for each in _Graph(reader, inner, depth + 1).nodes for name in each.inputs]


class _Graph:
    """A model's graph of operations and its weights."""

    def __init__(self, reader: _Reader, raw: Buffer, depth: int = 0) -> None:
        if depth > _MAX_NESTED_GRAPHS:
            raise NotSplit(f"has graphs that are nested more than {_MAX_NESTED_GRAPHS} levels deep")
        fields = reader.fields(raw)
        if any(number == _SPARSE_INITIALIZER for number, _, _ in fields):
            raise NotSplit("has sparse weights, unlike any Piper model")
        self.nodes = [_Node(reader, each, depth) for each in _messages(fields, _NODE)]
        self._weights = {_checked_tensor_name(reader, each): each for each in _messages(fields, _INITIALIZER)}
        self.inputs = [each for each in fields if each[:2] == (_INPUT, _BYTES)]
        self.outputs = [each for each in fields if each[:2] == (_OUTPUT, _BYTES)]

    def nodes_after(self, value_name: str) -> list[_Node]:
        """Return the nodes that depend on a value, directly or indirectly."""
        names = {value_name}
        found = []
        for node in self.nodes:
            if not names.isdisjoint(node.inputs):
                names.update(node.outputs)
                found.append(node)
        return found

    def nodes_for(self, value_names: Iterable[str]) -> list[_Node]:
        """Return the nodes that are needed to compute these values."""
        names = {*value_names}
        found = []
        for node in reversed(self.nodes):
            if not names.isdisjoint(node.outputs):
                names.update(node.inputs)
                found.append(node)
        return found[::-1]

    def constants(self) -> set[str]:
        """Return the names of the values that are the same in every run."""
        names = {*self._weights, ""}
        for node in self.nodes:
            if names.issuperset(node.inputs) and not node.operator.startswith(_RANDOM_PREFIX):
                names.update(node.outputs)
        return names

    def fields_of(self, nodes: list[_Node]) -> list[Field]:
        """Return the fields of a smaller graph with only these nodes and their weights.

        Fields for its inputs and outputs have to be added.
        """
        names = {name for each in nodes for name in each.inputs}
        weights = [(_INITIALIZER, _BYTES, each) for name, each in self._weights.items() if name in names]
        return [*((_NODE, _BYTES, each.raw) for each in nodes), (_GRAPH_NAME, _BYTES, b"half"), *weights]


def _is_shared(reader: _Reader, field: Field) -> bool:
    """Return whether to copy a field of the model into both halves.

    These fields are the version of the format, and the sets of standard operators.
    """
    number, kind, value = field
    if (number, kind) == (_OPERATOR_SETS, _BYTES):
        return "".join(_names(reader.fields(value), _DOMAIN)) in _STANDARD_DOMAINS
    return number == _IR_VERSION


def _checked_tensor_name(reader: _Reader, raw: Buffer) -> str:
    """Return the name of a tensor. Raise NotSplit if its data is in another file.

    Raises:
        NotSplit: The data is in another file.
    """
    fields = reader.fields(raw)
    locations = (value for number, _, value in fields if number in {_EXTERNAL_DATA, _DATA_LOCATION})
    if any(bytes(value) != b"\0" for value in locations):
        raise NotSplit("has its weights in another file")
    return "".join(_names(fields, _TENSOR_NAME))


def _messages(fields: Iterable[Field], field_number: int) -> list[Buffer]:
    """Return the content of all fields with this number."""
    return [value for number, kind, value in fields if (number, kind) == (field_number, _BYTES)]


def _names(fields: Iterable[Field], field_number: int) -> list[str]:
    """Return the content of all fields with this number, as strings."""
    found = _messages(fields, field_number)
    if any(len(value) > _MAX_NAME_BYTES for value in found):
        raise NotSplit("is not a Piper model: it has names that are too long")
    try:
        return [bytes(value).decode() for value in found]
    except UnicodeDecodeError as error:
        raise NotSplit("is not an ONNX model: it has names that are not UTF-8") from error


def _parse_integer(raw: Buffer, at: int) -> tuple[int, int]:
    """Decode the protobuf varint at an index. Return its value and the index of the next byte."""
    result = shift = 0
    while at < len(raw) and shift < 64:  # Longer integers aren't valid.
        byte = raw[at]
        at += 1
        result |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return result, at
    raise NotSplit("is truncated, or not an ONNX model")


def _encode_integer(value: int) -> bytes:
    """Encode an integer as a protobuf varint."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _encode_model(head: list[Field], graph: list[Field]) -> ModelHalf:
    """Encode a model with the fields `head` and a graph with the fields `graph`."""
    parts = list(_encode_fields(graph))
    key = _encode_integer(_GRAPH << 3 | _BYTES) + _encode_integer(sum(map(len, parts)))
    return (*_encode_fields(head), key, *parts)


def _encode_fields(fields: Iterable[Field]) -> Iterator[Buffer]:
    """Yield the encoded fields of a message, in parts."""
    for number, kind, value in fields:
        yield _encode_integer(number << 3 | kind)
        if kind == _BYTES:
            yield _encode_integer(len(value))
        yield value


def _encode_float_value(name: str) -> bytes:
    """Encode the description of an input or output that is a tensor of floats."""
    return b"".join(_encode_fields([(1, _BYTES, name.encode())])) + _FLOAT_TYPE
