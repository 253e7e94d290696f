"""Bytes of a file and a random stream in, the same damaged out: by what its kind is made of, or byte by byte."""

from __future__ import annotations

import copy
import functools
import gzip
import io
import json
import struct
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

SECRETS = tuple(f"secret.{ending}" for ending in ("obj", "png", "xml", "json", "npz", "glb", "yaml"))
"""Files beside the folder that is read."""
DEEP = "@deep@"
WORDS = (
    *("", "nan", "inf", "-1", "0", "1e308", "1e9", "-1e999", "99999999999", "1 2", "0 0 0", "x" * 300, "é\n", ".."),
    *("/", "/etc/passwd", *(f"../{name}" for name in SECRETS), "../../secret.obj", "model://../../secret.obj"),
    "file:///etc/passwd",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 0.5, 1e308, 10**400, 2**63, 2**64, float("nan"), float("inf"), 60_000, "\0", DEEP),
    *([], {}, [0, 0, 0, 0], [[]], ["a"], {"a": 1}, [1e300] * 3, [None] * 4, {"": None}, list(range(1000)), *WORDS),
)
NOISE = (b"\0", b"\xff" * 8, b"nan", b"-1", b"1e999", b"<", b"</", b"{", b"]", b'"', b"\n", b"v ", b"f 9 9 9\n", b"../")


def _places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of every value in a decoded tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from _places(value, (*path, key))


def _pick(rng: np.random.Generator, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def tree(value: Any, rng: np.random.Generator) -> Any:
    """A decoded JSON or YAML value with one place of it dropped, repeated, exchanged or made something else."""
    value = copy.deepcopy(value)
    places = list(_places(value))
    if not places or rng.random() < 0.03:
        return _pick(rng, VALUES)
    # Each depth alike: long lists of numbers would take nearly all.
    depth = _pick(rng, sorted({len(p) for p in places}))
    *path, key = _pick(rng, [p for p in places if len(p) == depth])
    at = value
    for step in path:
        at = at[step]
    kind = _pick(rng, ("drop", "value", "value", "value", "wrap", "repeat", "new key"))
    if kind == "drop":
        del at[key]
    elif kind == "repeat" and isinstance(at[key], list):
        at[key] = at[key] * 3
    elif kind == "new key" and isinstance(at, dict):
        at["x" * int(rng.integers(1, 300))] = _pick(rng, VALUES)
    elif kind == "wrap":
        at[key] = [at[key]] if rng.random() < 0.5 else {"a": at[key]}
    else:
        at[key] = _pick(rng, VALUES)
    return value


def _json(data: bytes, rng: np.random.Generator) -> bytes:
    text = json.dumps(tree(json.loads(data), rng))
    return text.replace(f'"{DEEP}"', "[" * 5000 + "]" * 5000).encode()


def _jsonl(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.splitlines()
    k = len(lines) - 1 if rng.random() < 0.5 else int(rng.integers(len(lines)))
    lines[k] = _json(lines[k], rng)
    return b"\n".join(lines) + b"\n"


def _yaml(data: bytes, rng: np.random.Generator) -> bytes:
    text = yaml.safe_dump(tree(yaml.safe_load(data), rng), sort_keys=False)
    if rng.random() < 0.2:  # anchors, at the beginning or in place of a value
        at = [k for k, c in enumerate(text) if c in "\n:"]
        where = _pick(rng, at) if at else 0
        return (text[: where + 1] + _pick(rng, ANCHORS)(int(rng.integers(1, 12))) + text[where + 1 :]).encode()
    return text.replace(f"'{DEEP}'", "[" * 2000 + "]" * 2000).encode()


def _aliases(levels: int) -> str:
    lists = (f"&l{k} [{', '.join([f'*l{k - 1}'] * 10)}]" for k in range(1, levels + 1))
    return f" [&l0 [x, 1], {', '.join(lists)}]\n"


def _merges(levels: int) -> str:
    maps = (f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 10)}]}}" for k in range(1, levels + 1))
    return f" {{m0: &m0 {{seed: 1}}, {', '.join(maps)}}}\n"


ANCHORS = (_aliases, _merges, lambda levels: f" &c{levels} {{a: *c{levels}}}\n", lambda levels: " &e" * levels + " 1\n")
"""YAML whose aliases expand to far more than the file holds."""


def _parquet(data: bytes, rng: np.random.Generator) -> bytes:
    rows = pq.read_table(io.BytesIO(data))
    k, count = int(rng.integers(rows.num_columns)), rows.num_rows
    name, column = rows.column_names[k], rows.column(k).combine_chunks()
    some = pa.array(rng.random(count) < 0.5)
    changed = {
        "text": lambda: pa.array([_pick(rng, WORDS)] * count),
        "numbers": lambda: pa.array([_pick(rng, FLOATS)] * count),
        "whole": lambda: pa.array([_pick(rng, (-1, 0, 3, 2**63 - 1))] * count), "nulls": lambda: pa.nulls(count),
        "gaps": lambda: pa.array([v if m else None for v, m in zip(column.to_pylist(), some.to_pylist(), strict=True)],
                                 column.type),
        "lists": lambda: pa.array([[1.0, 2.0]] * count), "flags": lambda: some,
        "maps": lambda: pa.array([{"category": "chair", "objects": 1}] * count),
        "bytes": lambda: pa.array([b"a"] * count),
        "dictionary": lambda: column.dictionary_encode() if not pa.types.is_nested(column.type) else column,
    }  # fmt: skip
    kind = _pick(rng, ("drop", "drop", "rename", "empty", "few", "twice", *changed))
    if kind in changed:
        rows = rows.set_column(k, name, changed[kind]())
    elif kind == "drop":
        rows = rows.drop_columns(name)
    elif kind == "rename":
        rows = rows.rename_columns([_pick(rng, WORDS) if n == name else n for n in rows.column_names])
    else:
        rows = {"empty": rows.slice(0, 0), "few": rows.slice(0, 1), "twice": pa.concat_tables([rows, rows])}[kind]
    out = io.BytesIO()
    pq.write_table(rows, out)
    return out.getvalue()


FLOATS = (float("nan"), float("inf"), -1.0, 0.0, 1e308, 2.0)


@functools.cache
def _bomb(mib: int, window: int) -> tuple[bytes, int]:
    """Zeros, packed a thousandfold, and their checksum."""
    coder, block, crc, parts = zlib.compressobj(1, wbits=window), bytes(2**20), 0, []
    for _ in range(mib):
        parts.append(coder.compress(block))
        crc = zlib.crc32(block, crc)
    return b"".join([*parts, coder.flush()]), crc


def _npz_bomb(name: str) -> bytes:
    """An archive of one array that unpacks to more than a GiB."""
    packed, crc = _bomb(1100, -15)
    entry, size = f"{name}.npy".encode(), 1100 << 20
    head = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0x21, crc, len(packed), size, len(entry), 0)
    local = b"PK\3\4" + head + entry + packed
    central = b"PK\1\2" + struct.pack("<H", 20) + head + struct.pack("<HHHII", 0, 0, 0, 0, 0) + entry
    return local + central + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)


def _xml(data: bytes, rng: np.random.Generator) -> bytes:
    root = ElementTree.fromstring(data)
    parents = [(parent, k) for parent in root.iter() for k in range(len(parent))]
    element = _pick(rng, list(root.iter()))
    kind = _pick(rng, ("drop", "repeat", "attribute", "attribute", "text", "tag", "deep", "less"))
    if kind in ("drop", "repeat") and parents:
        parent, k = _pick(rng, parents)
        if kind == "drop":
            del parent[k]
        else:
            parent.extend([parent[k]] * int(rng.integers(1, 40)))
    elif kind in ("attribute", "less") and any(e.attrib for e in root.iter()):
        element = _pick(rng, [e for e in root.iter() if e.attrib])
        name = _pick(rng, list(element.attrib))
        if kind == "attribute":
            element.set(name, _pick(rng, WORDS))
        else:
            del element.attrib[name]
    elif kind == "tag":
        element.tag = _pick(rng, [e.tag for e in root.iter()])
    elif kind == "deep":
        for _ in range(int(rng.integers(1, 400))):
            element = ElementTree.SubElement(element, element.tag, element.attrib)
    else:
        element.text = _pick(rng, WORDS)
    return ElementTree.tostring(root)


def _npz(data: bytes, rng: np.random.Generator) -> bytes:
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = _pick(rng, list(arrays))
    if rng.random() < 0.03:
        return _npz_bomb(name)
    array, kind = arrays[name], _pick(rng, ("drop", "flat", "empty", "float", "nan", "text", "more", "huge", "rename"))
    changed = {
        "flat": lambda: array.ravel(), "empty": lambda: array[:0] if array.ndim else np.zeros(0),
        "float": lambda: array.astype(np.float64) if array.dtype.kind in "bifu" else array,
        "nan": lambda: np.full(array.shape, np.nan), "text": lambda: np.array(["x" * 300]),
        "more": lambda: array[None], "huge": lambda: np.full(array.shape, 1e308), "rename": lambda: array,
    }  # fmt: skip
    del arrays[name]
    if kind != "drop":
        arrays[name + "x" * (kind == "rename")] = changed[kind]()
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _glb(data: bytes, rng: np.random.Generator) -> bytes:
    (length,) = struct.unpack("<I", data[12:16])
    text = _json(data[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def _zip(data: bytes, rng: np.random.Generator) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    # Half of the time the document that all hangs on.
    name = next((n for n in files if n.endswith(".xml") and rng.random() < 0.5), _pick(rng, list(files)))
    kind = _pick(rng, ("change", "change", "change", "drop", "rename"))
    content = files.pop(name)
    if kind != "drop":
        files[(_pick(rng, WORDS) or "x") if kind == "rename" else name] = (
            mutated(name, content, rng) if kind == "change" else content
        )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    words = lines[k].split(b" ")
    words[int(rng.integers(len(words)))] = _pick(rng, WORDS).encode()
    kind = _pick(rng, ("word", "word", "word", "drop", "repeat", "swap"))
    lines[k : k + 1] = {"word": [b" ".join(words)], "drop": [], "repeat": [lines[k]] * int(rng.integers(2, 2000)),
                        "swap": [_pick(rng, lines)]}[kind]  # fmt: skip
    return b"\n".join(lines)


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    at, count = int(rng.integers(len(data) + 1)), int(rng.integers(1, 64))
    noise = _pick(rng, NOISE) if rng.random() < 0.5 else rng.bytes(int(rng.integers(1, 16)))
    return {
        "cut": data[:at], "over": data[:at] + noise + data[at + len(noise) :], "in": data[:at] + noise + data[at:],
        "out": data[:at] + data[at + count :], "new": noise * count,
        "again": data[:at] + data[at : at + count] * 3 + data[at:],
        "flip": data[:at] + bytes(b ^ 1 << int(rng.integers(8)) for b in data[at : at + 3]) + data[at + 3 :],
    }[_pick(rng, ("cut", "over", "over", "in", "out", "new", "again", "flip", "flip"))]  # fmt: skip


KINDS = {".json": _json, ".jsonl": _jsonl, ".yaml": _yaml, ".xml": _xml, ".world": _xml, ".sdf": _xml, ".urdf": _xml,
         ".dae": _xml, ".npz": _npz, ".parquet": _parquet, ".glb": _glb, ".sh3d": _zip}  # fmt: skip
"""Ending -> how such files are changed by structure; others line by line."""


def mutated(name: str, data: bytes, rng: np.random.Generator) -> bytes:
    """The content of a file with one change; its name tells what it is made of."""
    ending = "." + name.rpartition(".")[2]
    if ending == ".gz" and rng.random() < 0.05:
        return _bomb(300, 31)[0]
    if ending == ".gz" and rng.random() < 0.7:
        return gzip.compress(mutated(name[:-3], gzip.decompress(data), rng), mtime=0)
    return (KINDS.get(ending, _lines) if rng.random() < 0.65 and ending != ".gz" else _bytes)(data, rng)
