"""Read files that others wrote: none blocks or never ends, none unpacks to many times its size."""

import contextlib
import lzma
import os
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from interactive_nav_common.errors import UserError, readable, regular

MOST_TEXT, MOST_ARRAYS = 2**28, 2**30
"""Bytes that a small file may unpack to."""
MOST_TIMES = 20
"""A large file may unpack to this many times its size."""
MOST_REPEATED = 10_000
"""Values of a YAML file that may stand where an alias repeats them."""
_DECODERS = {"gzip": lambda: zlib.decompressobj(31), "zlib": zlib.decompressobj, "xz": lzma.LZMADecompressor}


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a regular file; anything else raises OSError."""
    return regular(path).read_bytes()


def unpack(data: bytes, kind: str, most: int | None = None) -> bytes:
    """Return what gzip, zlib or xz packed; ValueError where that is damaged, cut short or too much."""
    most, decoder = most or max(MOST_TEXT, MOST_TIMES * len(data)), _DECODERS[kind]()
    try:
        content = decoder.decompress(data, most)
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise ValueError(f"it is not readable as packed with {kind}: {error}") from None
    if not decoder.eof:
        how = f"unpacks to more than {most / 2**20:g} MiB"
        if len(content) < most:
            how = f"is not readable as packed with {kind}: cut short"
        raise ValueError(f"it {how}")
    return content


def check_named(xml: Path, kind: type[UserError], remedy: str) -> None:
    """Refuse an MJCF file that names FIFOs or devices: MuJoCo would open them, and wait or read for ever."""
    roots: dict[str, ElementTree.Element] = {}
    left, elements = [str(xml)], []
    while left:
        with readable(path := left.pop(), kind, remedy, " as MJCF"):
            roots[path] = ElementTree.fromstring(read_bytes(path))
        elements += roots[path].iter()
        included = (os.path.join(xml.parent, e.get("file", "")) for e in roots[path].iter("include"))
        left += [place for place in included if os.path.isfile(place) and place not in roots]
    folders = {e.get(name, "") for e in elements for name in ("assetdir", "meshdir", "texturedir")} | {""}
    named = {value for e in elements for key, value in e.attrib.items() if key.startswith("file")}
    for place in (os.path.join(xml.parent, folder, value) for value in named for folder in folders):
        if os.path.exists(place):
            with readable(place, kind, remedy):
                regular(place)


@contextlib.contextmanager
def read_npz(path: Path, kind: type[UserError], remedy: str) -> Iterator[Any]:
    """Yield the arrays of an npz file by name; errors of the block, too, become one line of `kind`."""
    with readable(path, kind, remedy), zipfile.ZipFile(path) as archive:
        size, most = (
            sum(member.file_size for member in archive.infolist()),
            max(MOST_ARRAYS, MOST_TIMES * Path(path).stat().st_size),
        )
        if size > most:
            raise ValueError(f"it unpacks to {size >> 20:,} MiB, expected at most {most >> 20:,}")
        with np.load(path, allow_pickle=False) as stored:
            yield stored


class Loader(yaml.SafeLoader):
    """Reads YAML of users: anchors may be used, but a few hundred bytes of aliases must not stand for gigabytes."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._sizes: dict[yaml.Node, int] = {}
        self._repeated = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose as PyYAML does, and count what aliases repeat."""
        is_alias, mark = self.check_event(yaml.AliasEvent), self.peek_event().start_mark
        node: Any = super().compose_node(parent, index)
        if is_alias:
            self._repeated += self._sizes.get(node, MOST_REPEATED + 1)  # not complete: it would contain itself
            if self._repeated > MOST_REPEATED:
                problem = f"aliases repeat more than {MOST_REPEATED:,} values, or hold themselves; write them out"
                raise yaml.composer.ComposerError(None, None, problem, mark)
            return node
        within = node.value if isinstance(node, yaml.CollectionNode) else ()
        pairs = isinstance(node, yaml.MappingNode)
        self._sizes[node] = 1 + sum(self._sizes[n] for item in within for n in (item if pairs else (item,)))
        return node
