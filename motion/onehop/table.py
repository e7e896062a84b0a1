"""The lookup table: per (source, destination) and trigger frame one packed transition; O(1) query, memory-mapped.

An entry is one little-endian integer of whole bytes (the widths are in the header, so 20 clips of 20 s at 60 fps need
4 bytes for one hop and 6 for two): window number of the hop, s_s, s_h, [window number of the second hop, s_2],
[index of each blend length]. The largest window number marks a trigger without candidate; for a second hop it says
that there is none.

File: b"segue-onehop", version (uint32), header length (uint32), header (JSON, padded to 64 bytes), entries.
"""

import bisect
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from motion.errors import InputError
from motion.onehop.types import FIXED, SearchConfig, Transition

MAGIC = b"segue-onehop"
VERSION = 1
_PREFIX = struct.Struct("<12sII")


@dataclass(frozen=True, eq=False)
class LookupTable:
    """Transitions of `pairs` for every trigger frame. `open` one, or make one with `search.build`.

    pairs: {(source, destination): o_sd}; o_sd is 0 and unused in the regime "start". entries: (triggers, bytes) uint8.
    first: {(source, destination): row of its trigger 0}. result: the `search.SearchResult` it came from, or None.
    """

    clips: object
    config: SearchConfig
    pairs: dict
    entries: np.ndarray
    result: object = None
    first: dict = field(init=False)

    def __post_init__(self):
        first, row = {}, 0
        for source, destination in self.pairs:
            first[source, destination] = row
            row += self.clips.period(source)
        object.__setattr__(self, "first", first)
        base, number = _window_numbers(self.clips)
        clips = range(len(self.clips))
        lookup = {
            "_base": base, "_starts": base.tolist(), "_none": number, "_bits": _bits(number, self.config),
            # what a query needs at hand
            "_bytes": memoryview(np.ascontiguousarray(self.entries).reshape(-1)), "_width": self.entries.shape[1],
            "_index": {key: i for i in clips for key in (i, self.clips.names[i])},
            "_periods": [self.clips.period(i) for i in clips], "_looping": [self.clips.looping(i) for i in clips],
            "_cost": None if self.result is None else self.result.cost, "_lengths": self.config.lengths,
        }  # fmt: skip
        for key, value in lookup.items():
            object.__setattr__(self, key, value)

    @property
    def triggers(self):
        """Number of entries."""
        return len(self.entries)

    @property
    def bytes_per_trigger(self):
        return self.entries.shape[1]

    @classmethod
    def pack(cls, clips, config, pairs, result):
        """The table of a `search.SearchResult`."""
        table = cls(clips, config, pairs, np.zeros((0, 1), np.uint8), result)
        bits = table._bits
        lengths = np.array(config.lengths)

        def number(hop, frame):
            return np.where(hop >= 0, table._base[np.maximum(hop, 0)] + frame, table._none)

        columns = [number(result.hop, result.hop_frame), result.stay_source, result.stay_hop]
        if config.hops == 2:
            columns += [number(result.second_hop, result.second_frame), result.stay_second]
        if len(lengths) > 1:
            columns += [np.searchsorted(lengths, result.lengths[:, k]) for k in range(config.hops + 1)]
        value, at = np.zeros(len(result.hop), np.uint64), 0
        for column, width in zip(columns, bits):
            value |= np.where(result.hop >= 0, column, 0 if at else table._none).astype(np.uint64) << np.uint64(at)
            at += width
        count = (at + 7) // 8
        entries = np.ascontiguousarray(value.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :count])
        return cls(clips, config, pairs, entries, result)

    def query(self, source, destination, frame):
        """The Transition of a trigger at `frame` of clip `source` (any integer if it loops); clips by name or index.

        Raises InputError for a pair that the table does not hold, IndexError for a frame outside the source.
        """
        try:
            source, destination = self._index[source], self._index[destination]
        except KeyError:
            source, destination = self.clips.index(source), self.clips.index(destination)
        first = self.first.get((source, destination))
        if first is None:
            names = self.clips.names
            raise InputError(f"the table has no transition {names[source]} -> {names[destination]}; build it with one")
        frame, period = int(frame), self._periods[source]
        at = frame % period if self._looping[source] else frame
        if not 0 <= at < period:
            raise IndexError(f"{self.clips.names[source]}: trigger frame {frame} lies outside 0..{period - 1}")
        start = (first + at) * self._width
        value = int.from_bytes(self._bytes[start : start + self._width], "little")
        fields = []
        for width in self._bits:
            fields.append(value & ((1 << width) - 1))
            value >>= width
        cost = None if self._cost is None else float(self._cost[first + at])
        return self._transition(source, destination, frame, at, fields, cost)

    def _transition(self, source, destination, frame, at, fields, cost):
        config, two = self.config, self.config.hops == 2
        offset = frame if config.regime != FIXED else self.pairs[source, destination] + frame - at
        if fields[0] == self._none:
            return Transition(False, source, destination, frame, destination, offset, 0, 0, offset, (config.blend,))
        hop, u = self._window(fields[0])
        stay_source, stay_hop = fields[1], fields[2]
        second, stay_second, v = -1, 0, 0
        if two and fields[3] != self._none:
            second, v = self._window(fields[3])
            stay_second = fields[4]
        numbers = fields[3 + 2 * two :] or (0,) * (config.hops + 1)
        lengths = tuple([self._lengths[k] for k in numbers])
        if two and second < 0:
            lengths = lengths[0], lengths[2]
        time = stay_source + lengths[0] + stay_hop
        return Transition(
            True, source, destination, frame, hop, frame + stay_source - u, stay_source, stay_hop, offset, lengths,
            second, frame + time - v if second >= 0 else 0, stay_second, cost,
        )  # fmt: skip

    def _window(self, number):
        clip = bisect.bisect_right(self._starts, number) - 1
        return clip, number - self._starts[clip]

    def save(self, path):
        """Writes the table's file."""
        config, clips = self.config, self.clips
        header = {
            "names": list(clips.names),
            "hashes": list(clips.hashes),
            "fps": clips.fps,
            "config": {key: getattr(config, key) for key in config.__dataclass_fields__},
            "pairs": [[s, d, o] for (s, d), o in self.pairs.items()],
            "triggers": len(self.entries),
            "bytes": int(self.entries.shape[1]),
        }
        text = json.dumps(header, sort_keys=True, default=float).encode()
        text += b" " * (-(_PREFIX.size + len(text)) % 64)
        with open(path, "wb") as file:
            file.write(_PREFIX.pack(MAGIC, VERSION, len(text)))
            file.write(text)
            file.write(np.ascontiguousarray(self.entries).tobytes())

    @classmethod
    def open(cls, path, clips):
        """The table of a file, memory-mapped, for the very clips that it was built from.

        Raises InputError, one line with the remedy, for a foreign, truncated or outdated file and for other clips.
        """
        path = Path(path)
        header, start = _read_header(path)
        _check_clips(path, header, clips)
        config = SearchConfig(
            **{key: tuple(value) if isinstance(value, list) else value for key, value in header["config"].items()}
        )
        rows, width = header["triggers"], header["bytes"]
        size = path.stat().st_size
        if size != start + rows * width:
            raise InputError(f"{path}: has {size} bytes, its header says {start + rows * width}; build the table again")
        pairs = {(s, d): o for s, d, o in header["pairs"]}
        if sum(clips.period(source) for source, _ in pairs) != rows:
            raise InputError(f"{path}: holds {rows} triggers, not those of its pairs; build the table again")
        entries = np.memmap(path, np.uint8, "r", start, (rows, width)) if rows else np.zeros((0, width), np.uint8)
        return cls(clips, config, pairs, entries)


def _read_header(path):
    again = "build the table again"
    try:
        with open(path, "rb") as file:
            prefix = file.read(_PREFIX.size)
            if len(prefix) < _PREFIX.size or prefix[: len(MAGIC)] != MAGIC:
                raise InputError(f"{path}: is not a one-hop table; give a file that `build` wrote")
            _, version, length = _PREFIX.unpack(prefix)
            if version != VERSION:
                raise InputError(f"{path}: is version {version}, this program reads {VERSION}; {again}")
            text = file.read(length)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a table that `build` wrote") from error
    try:
        header = json.loads(text) if len(text) == length else None
    except ValueError:
        header = None
    keys = {"names", "hashes", "fps", "config", "pairs", "triggers", "bytes"}
    if not isinstance(header, dict) or not keys <= header.keys():
        raise InputError(f"{path}: its header is truncated or damaged; {again}")
    return header, _PREFIX.size + length


def _check_clips(path, header, clips):
    if abs(header["fps"] - clips.fps) > 1e-9:
        raise InputError(f"{path}: was built at {header['fps']:g} fps, the clips have {clips.fps:g}; build it again")
    if len(header["hashes"]) != len(clips):
        raise InputError(f"{path}: was built from {len(header['hashes'])} clips, not {len(clips)}; build it again")
    for name, digest, clip in zip(header["names"], header["hashes"], clips.clips):
        if digest != clip.content_hash:
            raise InputError(f"{path}: was built from another clip {name!r} than {clip.name!r}; build it again")


def _window_numbers(clips):
    """First window number of every clip (frames as windows of 1, so that no blend length changes it), and their sum."""
    counts = [clips.period(i) for i in range(len(clips))]
    return np.concatenate([[0], np.cumsum(counts)[:-1]]), int(sum(counts))


def _bits(windows, config):
    """Widths of an entry's fields in bits."""
    window, stay = int(windows).bit_length(), max(1, int(config.max_stay).bit_length())
    length = (len(config.lengths) - 1).bit_length()
    bits = [window, stay, stay]
    if config.hops == 2:
        bits += [window, stay]
    if length:
        bits += [length] * (config.hops + 1)
    if sum(bits) > 64:
        raise InputError(f"an entry would need {sum(bits)} bits; use fewer or shorter clips, or a smaller max_stay")
    return bits
