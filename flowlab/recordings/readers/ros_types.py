"""Opens recordings of ROS whose messages are not all known: a type that cannot be read costs its topics, no others."""

from pathlib import Path
from typing import TYPE_CHECKING

from flowlab.errors import first_line

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


def open_reader(path: Path) -> "tuple[AnyReader, dict[str, str]]":
    """A recording, opened; and the topics whose messages cannot be read, with the reason.

    ``rosbags`` reads the definitions of all messages together, and gives up on a recording where one is broken.
    """
    from contextlib import ExitStack

    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    _take_any_schema()
    # Before 2023, ROS 2 recordings did not say what their messages look like.
    default = get_typestore(Stores.ROS2_HUMBLE)
    reader = AnyReader([path], default_typestore=default)
    stack = ExitStack()
    try:
        for one in reader.readers:
            stack.enter_context(one)
        connections = [c for one in reader.readers for c in one.connections]
        told = any(c.msgdef.format.name != "NONE" for c in connections)
        reader.typestore = get_typestore(Stores.EMPTY) if told else default
        unread = {}
        for connection in connections:
            reason = _learn(reader.typestore, connection, reader.is2)
            if reason is not None:
                unread[connection.topic] = f"{connection.msgtype}: {reason}"
    except BaseException:
        stack.close()
        raise
    reader.stack, reader.connections = stack, connections
    return reader, unread


def _learn(store: "Typestore", connection: "Connection", is2: bool) -> str | None:
    """Have a store know the type of messages; the reason where that cannot be."""
    kind, definition = connection.msgtype, connection.msgdef
    try:
        if definition.format.name != "NONE":
            found = _definitions(kind, definition.format.name, definition.data)
            store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        if kind not in store.types:
            return "its messages are of an unknown type"
        if connection.digest and definition.format.name != "NONE":
            have = store.hash_rihs01(kind) if is2 else store.generate_msgdef(kind)[1]
            if have != connection.digest:
                return "its definition is not the one that its messages were written with"
        if getattr(connection.ext, "serialization_format", "cdr") not in ("cdr", ""):
            return f"its messages are serialized as {connection.ext.serialization_format}"
    except Exception as error:  # whatever the parsers of definitions raise
        return f"its definition cannot be read ({first_line(error)})"
    return None


def _definitions(kind: str, form: str, text: str) -> "dict[str, tuple[object, ...]]":
    """What a definition says, of a type and of those that it is made of."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if form == "MSG":
        return dict(get_types_from_msg(text, kind))
    line = "=" * 80 + "\n"
    if not text.startswith(f"{line}IDL: "):
        return dict(get_types_from_idl(text))
    found: dict[str, tuple[object, ...]] = {}
    for part in text.split(line)[1:]:
        found |= get_types_from_idl(part.partition("\n")[2])
    return found


def _take_any_schema() -> None:
    """Have ``rosbags`` take MCAP files with schemas of other kinds, such as JSON or Protobuf, beside those of ROS."""
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.rosbag2 import storage_mcap

    own = getattr(storage_mcap.get_msgdef, "of_rosbags", storage_mcap.get_msgdef)

    def get_msgdef(schema: object) -> MessageDefinition:
        try:
            return own(schema)
        except KeyError:
            return MessageDefinition(MessageDefinitionFormat.NONE, "")

    get_msgdef.of_rosbags = own  # type: ignore[attr-defined]
    storage_mcap.get_msgdef = get_msgdef
    storage_mcap.read_string = lambda file: storage_mcap.read_bytes(file).decode(errors="replace")
