"""Files made wrong: by what they mean where their form is known, else byte by byte; the same seed gives the same."""

import io
import json
import math
import os
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import google_crc32c
import numcodecs.zstd
import numpy as np
import yaml

NASTY: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 3, 0.5, -0.0, 1.5, 10**9, 2**31, 2**32, 2**63, -(2**63), 2**64, 10**20, 10**400,
    1e-320, 1e308, -1e308, float("nan"), float("inf"), float("-inf"), "", " ", "a", "0", "1", "1e999", "nan", "-1",
    "null", "true", "../../x", "/etc/passwd", "/dev/zero", ".", "..", "a/b", "a\\b", "a\0b", "\x1b[31m", "[/red]",
    "\u202eabc", "\ud800", "é" * 300, "x" * 100_000, "os:system", "builtins:exec", "sentinel_module:Thing",
    "sentinel_module", "!!python/object/apply:os.system", "${HOME}", "%s%n", "{0}", "<script>", "*", "&a",
    "rigid-bodies",
    "fdp", "dp3", "mba", [], {}, [[]], [0], [None], ["a"], [1, 2, 3], [0] * 1000, [[1, 2], [3]], {"a": 1}, {"": 0},
    [float("nan")] * 3, {"a": {"b": {"c": []}}}, -(10**5), 7, 16, 64, 255, 256, 65_536, 1 << 20,
)  # fmt: skip
"""Values that somebody's file may hold where another is meant."""
_INTEGERS = (0, 1, 2, 7, 255, 256, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
_SHAPES = (
    "()", "(0,)", "(-1,)", "(1,)", "(2, 8)", "(2, 8, 8)", "(2, 8, 8, 3)", "(10**20,)", "(100000000000000000000,)",
    "(1000000000000, 0)", "(0, 3)", "(2.5,)", "('a',)", "None", "[2]", "(True, 2)", "(4294967296, 4294967296)",
    "(" * 300, "(1,)*99", "2", "{}",
    "(1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1)",
)  # fmt: skip
_TYPES = (
    "'<f4'", "'<f8'", "'>f8'", "'|u1'", "'<u2'", "'|b1'", "'|O'", "'<U8'", "'|S8'", "'<M8[s]'", "'<c16'", "'|V0'",
    "'|S0'", "[('a', '<f4')]", "'<f16'", "'f'", "'x'", "3", "'<f2'", "'<i8'", "'" + "a" * 500 + "'", "'|V8'",
)  # fmt: skip


def mutate_file(path: Path, rng: random.Random) -> None:
    """Make a file wrong in some way, once or several times."""
    if rng.random() < 0.03:
        _replace(path, rng)
        return
    content = path.read_bytes()
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = mutate(content, path.name, rng)
    path.write_bytes(content)


def mutate(content: bytes, name: str, rng: random.Random) -> bytes:
    """Content made wrong, by the form that its name tells."""
    form = _form(content, name)
    if form is not None and rng.random() < 0.75:
        with suppress(Exception):  # content that was made wrong before has no form any more
            return form(content, rng)
    return _mutate_bytes(content, rng)


def _form(content: bytes, name: str) -> Callable[[bytes, random.Random], bytes] | None:
    suffix = name.rpartition(".")[2] if "." in name else ""
    if suffix in ("json", "zarray", "zgroup", "zattrs"):
        return _mutate_json
    if content.startswith(b"\x93NUMPY"):
        return _mutate_pickle if b"'|O'" in content[:128] else _mutate_npy
    if "/c/" in name:
        return _mutate_chunk
    if content.startswith(b"PK"):
        return _mutate_zip
    if content.startswith(b"\x89PNG"):
        return _mutate_png
    forms = {"yaml": _mutate_yaml, "jsonl": _mutate_lines, "safetensors": _mutate_safetensors}
    return forms.get(suffix, _mutate_text if suffix in ("txt", "csv") else None)


def nasty_text(rng: random.Random) -> str:
    """A value as somebody may type it."""
    value = rng.choice(NASTY)
    if isinstance(value, str):
        return value
    with suppress(ValueError):
        return json.dumps(value)
    return str(value)[:100]


def _replace(path: Path, rng: random.Random) -> None:
    """Put something else in the place of a file."""
    how = rng.randrange(7)
    path.unlink()
    if how == 0:
        path.write_bytes(b"")
    elif how == 1:
        path.mkdir()
    elif how == 2:
        os.mkfifo(path)
    elif how == 3:
        path.symlink_to(rng.choice(("/dev/zero", "/dev/stdin", "/dev/full", "/proc/self/mem", "/etc")))
    elif how == 4:
        path.symlink_to(path.name)
    elif how == 5:
        path.symlink_to("nowhere")


def _mutate_bytes(content: bytes, rng: random.Random) -> bytes:
    data, how = bytearray(content), rng.randrange(8)
    at = rng.randrange(len(data) + 1)
    if how == 0 and data:
        data[at % len(data)] ^= 1 << rng.randrange(8)
    elif how == 1 and data:
        data[at % len(data)] = rng.randrange(256)
    elif how == 2:
        del data[at:]
    elif how == 3:
        data[at:at] = rng.randbytes(rng.randrange(1, 9))
    elif how == 4:
        end = rng.randrange(at, len(data) + 1)
        data[at:at] = data[at:end][:10_000]
    elif how == 5:
        del data[at : at + rng.randrange(1, 17)]
    elif how == 6:
        size = rng.choice("BHIQ")
        number = struct.pack(rng.choice("<>") + size, rng.choice(_INTEGERS) & ((1 << (8 * struct.calcsize(size))) - 1))
        data[at : at + len(number)] = number
    else:
        data[at:at] = rng.choice((b"\0", b"\xff\xfe", b"\xc3\x28", b"\n", b'"', b"[" * 500, b"{" * 500, b"9" * 5000))
    return bytes(data)


def _places(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, inner in items:
        found += _places(inner, (*path, key))
    return found


def mutate_values(values: Any, rng: random.Random) -> Any:
    """Nested values with one of them made wrong."""
    places = _places(values)
    if not places or rng.random() < 0.03:
        return rng.choice(NASTY)
    *path, last = rng.choice(places)
    inner = values
    for key in path:
        inner = inner[key]
    how = rng.randrange(8)
    if how == 0:
        del inner[last]
    elif how == 1 and isinstance(inner, dict):
        inner[rng.choice([str(n) for n in NASTY if isinstance(n, str)])] = inner.pop(last)
    elif how == 2:
        inner[last] = [inner[last]]
    elif how == 3:
        *elsewhere, key = rng.choice(places)
        other = values
        with suppress(Exception):
            for step in elsewhere:
                other = other[step]
            inner[last] = json.loads(json.dumps(other[key]))
    elif how == 4 and isinstance(inner[last], int | float) and not isinstance(inner[last], bool):
        inner[last] = rng.choice((-inner[last], inner[last] * 1000, inner[last] + 1, inner[last] - 1, str(inner[last])))
    else:
        inner[last] = rng.choice(NASTY)
    return values


def _mutate_json(content: bytes, rng: random.Random) -> bytes:
    text = json.dumps(mutate_values(json.loads(content), rng))
    if rng.random() < 0.03:
        text = text.replace("0", rng.choice(("9" * 5000, "[" * 500 + "]" * 500, "1e99999")), 1)
    return text.encode("utf-8", "surrogatepass")


def _mutate_yaml(content: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.1:
        levels = "\n".join(f"l{k}: &l{k} [{', '.join([f'*l{k - 1}'] * 9)}]" for k in range(1, 10))
        return content + f"\nl0: &l0 [x]\n{levels}\n".encode()
    if b"&l0" in content:  # such a bomb would go off here
        return _mutate_bytes(content, rng)
    values = mutate_values(yaml.safe_load(content), rng)
    return yaml.dump(values, allow_unicode=True).encode("utf-8", "surrogatepass")


def _mutate_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    at = rng.randrange(len(lines))
    how = rng.randrange(4)
    if how == 0:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif how == 1:
        del lines[at]
    elif lines[at]:
        lines[at] = _mutate_json(lines[at], rng)
    return b"\n".join(lines)


def _mutate_text(content: bytes, rng: random.Random) -> bytes:
    lines = content.decode().split("\n")
    at, how = rng.randrange(len(lines)), rng.randrange(5)
    words = lines[at].replace(",", " ").split(" ")
    if how == 0:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif how == 1:
        del lines[at]
    elif how == 2:
        lines[at] = lines[at].replace(rng.choice(words) or " ", nasty_text(rng), 1)
    elif how == 3:
        lines[at] += rng.choice((",", " ", ";", "\t")) + nasty_text(rng)
    else:
        lines[at] = nasty_text(rng)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _mutate_npy(content: bytes, rng: random.Random) -> bytes:
    file = io.BytesIO(content)
    values = np.load(file)
    how = rng.randrange(4)
    if how == 0 and values.dtype.kind == "f" and values.size:
        values = values.copy()
        values.flat[rng.randrange(values.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e300, -1, 0))
        return npy_bytes(values)
    if how == 1:
        return npy_bytes(rng.choice((values[None], values[..., None], values[:1], values[:0], values.T, values.ravel(),
                                     values.reshape(-1)[0], np.repeat(values, 2, 0))))  # fmt: skip
    if how == 2:
        kinds = ("f2", "f4", ">f8", "u1", "u2", "i8", "b1", "c8", "U5", "S3", "M8[s]")
        with np.errstate(all="ignore"):
            return npy_bytes(values.astype(rng.choice(kinds)))
    kind = repr(values.dtype.str) if rng.random() < 0.5 else rng.choice(_TYPES)
    shape = repr(values.shape) if rng.random() < 0.3 else rng.choice(_SHAPES)
    order = rng.choice(("True", "False", "3"))
    header = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + values.tobytes()


def npy_bytes(values: Any) -> bytes:
    """An array as ``numpy.save`` writes it."""
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def _mutate_pickle(content: bytes, rng: random.Random) -> bytes:
    end = content.index(b"\n") + 1
    head, body = content[:end], bytearray(content[end:])
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        at = rng.randrange(len(body))
        how = rng.randrange(5)
        if how == 0:
            body[at] = rng.choice(
                b"()]}0125BCGIJKLMNRSTUVX\x80\x81\x82\x85\x86\x87\x88\x89\x8a\x8c\x8e\x93\x94\x95bcdehijlopqrstu."
            )
        elif how == 1:
            body[at:at] = rng.choice(
                (b"cos\nsystem\n(S'touch pwned'\ntR", b"cbuiltins\nexec\n", b"cnumpy\ndtype\n", b"j\xff\xff\xff\x7f",
                 b"r\xff\xff\xff\x7f", b"\x8b\xff\xff\xff\x7f", b"R", b"b", b"0", b"2", b"(", b"t", b"N",
                 b"}", b"]", b")")
            )  # fmt: skip
        else:
            body = bytearray(_mutate_bytes(bytes(body), rng)) or bytearray(b".")
    return head + bytes(body)


def _mutate_zip(content: bytes, rng: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {i.filename: archive.read(i) for i in archive.infolist()}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        method = archive.infolist()[0].compress_type if rng.random() < 0.97 else zipfile.ZIP_DEFLATED
    name = rng.choice(list(members))
    how, made = rng.randrange(6), io.BytesIO()
    if how < 3:
        members[name] = mutate(members[name], name, rng)
    elif how == 3:
        members[rng.choice(("../../x.npy", "/x.npy", "a\\b.npy", "x", "", "\x1b.npy", "rgb.npy", "depth.npy"))] = (
            members.pop(name)
        )
    elif how == 4:
        members[name] = bytes(rng.choice((0, 10, 1 << 20, 30 << 20)))
    else:
        del members[name]
    with zipfile.ZipFile(made, "w", method) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return made.getvalue()


def _mutate_chunk(content: bytes, rng: random.Random) -> bytes:
    """A chunk of a shard, whose checksum is right again."""
    values = bytearray(numcodecs.zstd.decompress(content[:-4]))
    if rng.random() < 0.5:
        number = struct.pack("<f", rng.choice((math.nan, math.inf, -math.inf, 1e30, -1.0, 0.0)))
        at = rng.randrange(max(1, len(values) // 4)) * 4
        values[at : at + 4] = number
    else:
        values = bytearray(_mutate_bytes(bytes(values), rng))
    payload = numcodecs.zstd.compress(bytes(values), 1)
    return payload + google_crc32c.value(payload).to_bytes(4, "little")


def _mutate_png(content: bytes, rng: random.Random) -> bytes:
    chunks, at = [], 8
    while at < len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        chunks.append([content[at + 4 : at + 8], bytearray(content[at + 8 : at + 8 + size])])
        at += 12 + size
    how, chunk = rng.randrange(5), rng.choice(chunks)
    if how < 2:
        chunk = chunks[0]
        place, size = rng.choice(((0, 4), (4, 4), (8, 1), (9, 1), (10, 1), (11, 1), (12, 1)))
        number = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 16_000, 100_000, 1 << 31)) % (1 << (8 * size))
        chunk[1][place : place + size] = number.to_bytes(size, "big")
    elif how == 2 and chunk[1]:
        chunk[1][rng.randrange(len(chunk[1]))] ^= 1 << rng.randrange(8)
    elif how == 3:
        kind = rng.choice((b"acTL", b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"IHDR"))
        chunks.insert(rng.randrange(len(chunks) + 1), [kind, bytearray(rng.randbytes(rng.randrange(30)))])
    else:
        chunks.remove(chunk)
    parts = [len(d).to_bytes(4, "big") + k + bytes(d) + zlib.crc32(k + bytes(d)).to_bytes(4, "big") for k, d in chunks]
    return content[:8] + b"".join(parts)


def _mutate_safetensors(content: bytes, rng: random.Random) -> bytes:
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    text = json.dumps(mutate_values(header, rng)).encode("utf-8", "surrogatepass")
    size = len(text) if rng.random() < 0.9 else rng.choice(_INTEGERS)
    return struct.pack("<Q", size) + text + content[8 + length :]
