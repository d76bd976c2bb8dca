"""Videos of every kind, made here: each frame carries its number as a bar code, and a colour in each corner.

``python tests/data/videos.py`` makes them all, brings each in, compares every stored frame with what it
should show (and, where an ffmpeg program is found, with what that decodes), and prints a table in Markdown;
``--long`` adds those that take minutes. The tests do the same in one limited process.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.filter
import numpy as np
from PIL import Image

SIZE = (96, 64)
COLOURS = {"R": (220, 30, 30), "G": (30, 200, 30), "B": (30, 30, 220), "Y": (210, 210, 30)}
_BITS = 10
_TICK = Fraction(1, 90000)


def numbered(number: int, width: int = SIZE[0], height: int = SIZE[1]) -> np.ndarray:
    """A picture (H, W, 3): the number in the middle third, corners R G above B Y."""
    image = np.full((height, width, 3), 128, np.uint8)
    for bit in range(_BITS):
        columns = slice(bit * width // _BITS, (bit + 1) * width // _BITS)
        image[height // 3 : height * 2 // 3, columns] = 235 if number >> bit & 1 else 20
    h, w = height // 4, width // 4
    for name, (y, x) in zip("RGBY", ((0, 0), (0, -w), (-h, 0), (-h, -w)), strict=True):
        image[y : y + h or None, x : x + w or None] = COLOURS[name]
    return image


def number_of(image: np.ndarray) -> int:
    """The number that a picture carries, after any compression and scaling."""
    height, width = image.shape[:2]
    band = image[height * 4 // 10 : height * 6 // 10].mean((0, 2))
    return sum(int(band[(2 * bit + 1) * width // (2 * _BITS)] > 128) << bit for bit in range(_BITS))


def corners_of(image: np.ndarray) -> str:
    """The colours of the corners, as ``RG/BY``."""
    height, width = image.shape[:2]
    y, x = height // 10, width // 10
    seen = ""
    for place in ((y, x), (y, -x - 1), (-y - 1, x), (-y - 1, -x - 1)):
        off = {name: np.abs(image[place].astype(int) - colour).sum() for name, colour in COLOURS.items()}
        seen += min(off, key=off.__getitem__)
    return f"{seen[:2]}/{seen[2:]}"


def combed(image: np.ndarray) -> float:
    """How far neighbouring lines differ in the bar code, whose columns are of one colour each, of 255."""
    height = image.shape[0]
    band = image[height * 4 // 10 : height * 6 // 10].astype(float).mean(2)
    columns = [(2 * bit + 1) * image.shape[1] // (2 * _BITS) for bit in range(_BITS)]
    return float(np.abs(np.diff(band[:, columns], axis=0)).mean(0).max()) if len(band) > 1 else 0.0


# --- making ---------------------------------------------------------------------------------------


def encode(
    path: Path, codec: str, *, frames: Iterable[np.ndarray] | int = 12, pix_fmt: str = "yuv420p",
    rate: Fraction | int = 30, stamps: Sequence[float] | None = None, size: tuple[int, int] = SIZE,
    options: dict[str, str] | None = None, muxing: dict[str, str] | None = None, container: str | None = None,
    aspect: Fraction | None = None, sound: tuple[str, float] | None = None, lasts: float | None = None,
    upper_first: bool = False,
) -> None:  # fmt: skip
    """Writes a video.

    Args:
        path: Where.
        codec: An encoder of FFmpeg.
        frames: Pictures, (H, W, 3), or how many numbered ones.
        pix_fmt: Of the encoder.
        rate: Pictures per second.
        stamps: When each comes, seconds, if not by the rate.
        size: Width and height.
        options: Of the encoder.
        muxing: Of the container.
        container: Its format, if the suffix does not tell.
        aspect: Width of a pixel by its height.
        sound: An audio encoder and for how long, seconds.
        lasts: How long the last picture stays, seconds.
        upper_first: Mark pictures as interlaced, the upper field the earlier.
    """
    pictures = (numbered(i, *size) for i in range(frames)) if isinstance(frames, int) else frames
    with av.open(str(path), "w", format=container, options=muxing or {}) as file:
        quiet = {"x265-params": "log-level=none"} if codec == "libx265" else {}
        stream = file.add_stream(codec, rate=rate, options=quiet | (options or {}))
        stream.width, stream.height, stream.pix_fmt = *size, pix_fmt
        if aspect is not None:
            stream.sample_aspect_ratio = aspect
        if stamps is not None:
            stream.codec_context.time_base = _TICK
        voice = file.add_stream(sound[0], rate=48000, layout="mono") if sound else None
        if voice is not None:
            voice.bit_rate = 64000
        packets = []
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pix_fmt)
            if upper_first:
                frame = _marked(frame)
            frame.time_base = _TICK if stamps is not None else 1 / Fraction(rate)
            frame.pts = i if stamps is None else round(stamps[i] * 90000)
            packets += stream.encode(frame)
        packets += stream.encode(None)
        if lasts is not None:
            packets[-1].duration = round(lasts / packets[-1].time_base)
        if voice is not None and sound is not None:
            for at in range(0, int(sound[1] * 48000), 960):
                silence = av.AudioFrame.from_ndarray(np.zeros((1, 960), np.int16), "s16", "mono")
                silence.sample_rate, silence.pts, silence.time_base = 48000, at, Fraction(1, 48000)
                packets += voice.encode(silence)
            packets += voice.encode(None)
        for packet in sorted(packets, key=lambda p: p.dts * p.time_base if p.dts is not None else 0):
            file.mux(packet)


def _marked(frame: av.VideoFrame) -> av.VideoFrame:
    graph = av.filter.Graph()
    entry = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=_TICK)
    graph.link_nodes(entry, graph.add("setfield", "tff"), graph.add("buffersink")).configure()
    graph.vpush(frame)
    return graph.vpull()


def woven(count: int, size: tuple[int, int], *, first: int = 1) -> list[np.ndarray]:
    """Interlaced pictures of two fields: field j shows number j // 3.

    Args:
        count: How many pictures.
        size: Width and height.
        first: Which lines belong to the earlier field: 0 the upper ones, 1 the lower ones.
    """
    pictures = []
    for k in range(count):
        picture = numbered((2 * k + 1) // 3, *size)
        picture[first::2] = numbered(2 * k // 3, *size)[first::2]
        pictures.append(picture)
    return pictures


def _dv(path: Path, pictures: list[np.ndarray] | int = 10) -> None:
    encode(path, "dvvideo", frames=pictures, rate=25, size=(720, 576))


def _animated(path: Path, delays: list[int], **how: Any) -> None:
    """GIF, APNG or WebP with delays in ms."""
    images = [Image.fromarray(numbered(i)) for i in range(len(delays))]
    images[0].save(path, save_all=True, append_images=images[1:], duration=delays, **how)


def _turned(path: Path, matrix: tuple[int, int, int, int]) -> None:
    """An mp4 whose display matrix (tkhd) says how it is to be turned."""
    encode(path, "mpeg4", options={"qscale": "2", "flags": "+qscale"})
    content = bytearray(path.read_bytes())
    a, b, c, d = (value * 0x10000 for value in matrix)
    nine = (a, b, 0, c, d, 0, 0, 0, 0x40000000)
    at = content.index(b"tkhd") + 44
    content[at : at + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in nine)
    path.write_bytes(content)


def _trimmed(path: Path) -> None:
    """The first 0.4 s cut off without encoding again: an edit list hides them from the key frame on."""
    whole = path.with_name("whole-" + path.name)
    encode(whole, "libx264", frames=30, options={"g": "60", "preset": "ultrafast"})
    with av.open(str(whole)) as source, av.open(str(path), "w") as out:
        stream = source.streams.video[0]
        copy = out.add_stream_from_template(stream)
        for packet in source.demux(stream):
            if packet.dts is not None:
                packet.pts -= round(0.4 / stream.time_base)
                packet.dts -= round(0.4 / stream.time_base)
                packet.stream = copy
                out.mux(packet)
    whole.unlink()


def _patched(path: Path, codec: str, old: bytes, new: bytes) -> None:
    """Another codec's name in the container."""
    encode(path, codec)
    path.write_bytes(path.read_bytes().replace(old, new))


def _cut(path: Path, codec: str, share: float, **how: Any) -> None:
    """Broken off after this share of its bytes."""
    encode(path, codec, frames=60, **how)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def _only_sound(path: Path) -> None:
    with av.open(str(path), "w") as file:
        voice = file.add_stream("aac", rate=48000, layout="mono")
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 48000), np.int16), "s16", "mono")
        silence.sample_rate, silence.pts, silence.time_base = 48000, 0, Fraction(1, 48000)
        for packet in [*voice.encode(silence), *voice.encode(None)]:
            file.mux(packet)


def _grows(path: Path) -> None:
    """Raw H.264 whose size changes on the way."""
    small, large = path.with_name("s-" + path.name), path.with_name("l-" + path.name)
    encode(small, "libx264", frames=[numbered(i) for i in range(10)], options=_X264)
    encode(large, "libx264", frames=[numbered(i, 192, 128) for i in range(10, 20)], size=(192, 128),
           options=_X264)  # fmt: skip
    path.write_bytes(small.read_bytes() + large.read_bytes())
    small.unlink()
    large.unlink()


def jittered(count: int, rate: float, within: float, seed: int = 0) -> list[float]:
    """Time stamps of a rate, each up to ``within`` seconds early or late but for the first."""
    off = np.random.default_rng(seed).uniform(-within, within, count)
    off[0] = 0.0
    return list(np.round((np.arange(count) / rate + off) * 90000) / 90000)


# --- the kinds ------------------------------------------------------------------------------------


def at_rate(count: int, rate: float, fps: float = 30.0) -> list[int]:
    """What is to be seen at a fixed rate of pictures that come at another."""
    return [int(k * rate / fps + 1e-6) for k in range(round(count / rate * fps))]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One file and what must come of it."""

    file: str
    make: Callable[[Path], None]
    expected: list[int] = field(default_factory=lambda: list(range(12)))
    """Number of each frame that is stored; -1 where it cannot be read, since it is turned."""
    size: tuple[int, int] = SIZE
    corners: str = "RG/BY"
    options: dict[str, Any] = field(default_factory=dict)
    """Of the import: start, end."""
    refused: str = ""
    """What is said instead, as a regular expression."""
    long: bool = False
    """Takes seconds to make."""


_X264 = {"preset": "ultrafast", "crf": "16"}
_VP8 = {"deadline": "realtime", "b": "2M"}
_PLAIN264 = _X264 | {"bf": "0"}
_Q = {"qscale": "2", "flags": "+qscale"}


def _plain(
    file: str, codec: str, pix_fmt: str = "yuv420p", *, options: dict | None = None, **how: Any
) -> Kind:
    made = how.pop("made", {})
    return Kind(
        file=file, make=lambda path: encode(path, codec, pix_fmt=pix_fmt, options=options, **made), **how
    )


def _orientation(name: str, matrix: tuple[int, int, int, int]) -> Kind:
    """By the definition: (x, y) goes to (a x + c y, b x + d y)."""
    a, b, c, d = matrix
    place = {}
    for colour, (x, y) in zip("RGBY", ((-1, -1), (1, -1), (-1, 1), (1, 1)), strict=True):
        place[b * x + d * y, a * x + c * y] = colour
    seen = "".join(place[key] for key in sorted(place))
    return Kind(
        file=f"{name}.mp4", make=lambda path: _turned(path, matrix), corners=f"{seen[:2]}/{seen[2:]}",
        size=SIZE if a else SIZE[::-1], expected=[-1] * 12,
    )  # fmt: skip


_FIELDS = [2 * n // 3 for n in at_rate(10, 25)]
_GIF_DELAYS = [1000, 100, 100, 500, 2000, 100, 3000]

KINDS: list[Kind] = [
    # What people have, by codec and container.
    _plain("h264.mp4", "libx264", options=_X264 | {"bf": "2"}),
    _plain("h264-b.mov", "libx264", options={"preset": "fast", "crf": "16", "bf": "3"}),
    _plain("h264-10bit.mkv", "libx264", "yuv420p10le", options=_X264),
    _plain("h264-444.mp4", "libx264", "yuv444p", options=_X264),
    _plain("h264.ts", "libx264", options=_X264),
    _plain("h264.flv", "libx264", options=_X264),
    _plain("h264.h264", "libx264", options=_X264, expected=at_rate(12, 25)),
    _plain("hevc.mp4", "libx265", options={"preset": "ultrafast"}),
    _plain("hevc-10bit.mov", "libx265", "yuv420p10le", options={"preset": "ultrafast"}),
    _plain("av1.mp4", "libsvtav1", options={"preset": "12"}),
    _plain("av1-10bit.mkv", "libsvtav1", "yuv420p10le", options={"preset": "12"}),
    _plain("av1.webm", "libsvtav1", options={"preset": "12"}),
    _plain("vp8.webm", "libvpx", options=_VP8),
    _plain("vp9.webm", "libvpx-vp9", options=_VP8 | {"cpu-used": "8"}),
    _plain("vp9.ivf", "libvpx-vp9", options=_VP8 | {"cpu-used": "8"}),
    _plain("prores.mov", "prores_ks", "yuv422p10le"),
    _plain("dnxhr.mxf", "dnxhd", "yuv422p", options={"profile": "dnxhr_sq"}, made={"size": (256, 128)},
           size=(256, 128)),
    _plain("mpeg2.mxf", "mpeg2video", options=_Q),
    _plain("mpeg2.ts", "mpeg2video", options=_Q),
    _plain("mpeg2.mpg", "mpeg2video", options=_Q),
    _plain("mpeg4.avi", "mpeg4", options=_Q),
    _plain("mpeg4-b.avi", "mpeg4", options=_Q | {"bf": "2"}),
    _plain("mpeg4.3gp", "mpeg4", options=_Q),
    _plain("mjpeg.avi", "mjpeg", "yuvj420p", options=_Q),
    _plain("wmv2.wmv", "wmv2", options=_Q),
    _plain("flv1.flv", "flv", options=_Q),
    _plain("vp8.mkv", "libvpx", options={"deadline": "realtime", "b": "2M", "auto-alt-ref": "1",
                                         "lag-in-frames": "8"}),
    _plain("ffv1.mkv", "ffv1"),
    _plain("huffyuv.avi", "huffyuv", "yuv422p"),
    _plain("qtrle.mov", "qtrle", "rgb24"),
    _plain("raw.avi", "rawvideo", "bgr24"),
    _plain("raw.y4m", "rawvideo"),
    Kind(file="dv.avi", make=_dv, expected=at_rate(10, 25), size=(640, 480)),
    Kind(file="dv.dv", make=_dv, expected=at_rate(10, 25), size=(640, 480)),
    _plain("live.webm", "libvpx", options=_VP8, made={"muxing": {"live": "1"}}),
    _plain("fragments.mp4", "libx264", options=_X264,
           made={"muxing": {"movflags": "frag_keyframe+empty_moov"}}),
    Kind(file="grows.h264", make=_grows, expected=at_rate(20, 25)),
    # Animated pictures: browsers play delays of up to 10 ms as 100 ms.
    Kind(file="delays.gif", make=lambda path: _animated(path, _GIF_DELAYS),
         expected=[i for i, delay in enumerate(_GIF_DELAYS) for _ in range(delay * 3 // 100)]),
    Kind(file="fast.gif", make=lambda path: _animated(path, [10] * 8), expected=at_rate(8, 10)),
    Kind(file="delays.apng", make=lambda path: _animated(path, [100, 300, 200], format="PNG"),
         expected=[0] * 3 + [1] * 9 + [2] * 6),
    Kind(file="delays.webp", make=lambda path: _animated(path, [100, 300, 200], lossless=True),
         expected=[0] * 3 + [1] * 9 + [2] * 6),
    # Two moments in one picture: the earlier is shown.
    Kind(file="interlaced.mp4", expected=_FIELDS, size=(128, 96), make=lambda path: encode(
        path, "libx264", frames=woven(10, (128, 96), first=0), upper_first=True, size=(128, 96), rate=25,
        options=_X264 | {"x264-params": "tff=1"})),
    Kind(file="interlaced.ts", expected=_FIELDS, size=(128, 96), make=lambda path: encode(
        path, "mpeg2video", frames=woven(10, (128, 96)), size=(128, 96), rate=25,
        options={"qscale": "2", "flags": "+qscale+ildct+ilme"})),
    Kind(file="interlaced-dv.avi", expected=_FIELDS, size=(640, 480),
         make=lambda path: _dv(path, woven(10, (720, 576)))),
    _plain("flagged-interlaced.mp4", "libx264", options=_X264 | {"x264-params": "fake-interlaced=1"}),
    # The shape of a pixel, and which way is up.
    _plain("wide-pixels.mp4", "libx264", options=_X264, made={"aspect": Fraction(64, 45), "size": (90, 64)},
           size=(128, 64)),
    _plain("wide-pixels.mkv", "libx264", options=_X264, made={"aspect": Fraction(4, 3)}, size=(128, 64)),
    _plain("narrow-pixels.ts", "mpeg2video", options=_Q, made={"aspect": Fraction(8, 9), "size": (90, 60)},
           size=(80, 60)),
    _orientation("turned-90", (0, 1, -1, 0)),
    _orientation("turned-180", (-1, 0, 0, -1)),
    _orientation("turned-270", (0, -1, 1, 0)),
    _orientation("mirrored", (-1, 0, 0, 1)),
    _orientation("upside-down", (1, 0, 0, -1)),
    _orientation("transposed", (0, 1, 1, 0)),
    _orientation("anti-transposed", (0, -1, -1, 0)),
    # Lengths: edit lists, sound, still ends.
    Kind(file="edit-list.mp4", make=_trimmed, expected=list(range(12, 30))),
    _plain("sound-longer.mp4", "libx264", options=_X264, made={"sound": ("aac", 2.0)}),
    _plain("sound-longer.webm", "libvpx", options=_VP8,
           made={"sound": ("libopus", 2.0)}),
    *(
        _plain(f"still-end.{suffix}", codec, options=options, expected=[*range(12), *[11] * rest],
               made={"sound": (voice, 2.0), **more})
        for suffix, codec, options, voice, more, rest in (
            ("webm", "libvpx", _VP8, "libopus", {"muxing": {"live": "1"}}, 48),
            ("ts", "mpeg2video", _Q, "mp2", {}, 48),
            ("flv", "libx264", _X264, "aac", {}, 49),
            ("wmv", "wmv2", _Q, "wmav2", {}, 49),
        )
    ),
    _plain("still-end.mp4", "libx264", options=_X264, made={"lasts": 1.0}, expected=[*range(12), *[11] * 29]),
    _plain("still-end.mkv", "libx264", options=_X264, made={"lasts": 1.0}, expected=[*range(12), *[11] * 29]),
    # Time stamps beside the grid.
    *(
        Kind(file=f"jitter-{within}ms.mp4", expected=list(range(60)), make=lambda path, within=within: encode(
            path, "libx264", frames=60, stamps=jittered(60, 30, within / 1000), options=_PLAIN264))
        for within in (1, 4, 8)
    ),
    Kind(file="29.97.mkv", expected=list(range(60)), make=lambda path: encode(
        path, "mpeg4", frames=60, rate=Fraction(30000, 1001), options=_Q)),
    Kind(file="60fps-jitter.mp4", expected=list(range(0, 60, 2)), make=lambda path: encode(
        path, "libx264", frames=60, stamps=jittered(60, 60, 0.004), options=_PLAIN264)),
    Kind(file="uneven.mkv", expected=[0] * 3 + [1] * 12 + [2] * 6 + [3] * 3 + [4], make=lambda path: encode(
        path, "libx264", frames=5, stamps=[0, 0.1, 0.5, 0.7, 0.8], options=_PLAIN264)),
    Kind(file="pause.mkv", options={"start": 1.5, "end": 3.5}, expected=[29] * 45 + list(range(30, 45)),
         make=lambda path: encode(path, "libx264", frames=60, options=_PLAIN264,
                                  stamps=[(i if i < 30 else i + 60) / 30 for i in range(60)])),
    Kind(file="ten-minutes.mp4", options={"start": 590.0, "end": 591.0},
         expected=[900 + k // 3 for k in range(30)],
         make=lambda path: encode(path, "mpeg4", frames=(numbered(i % 1000, 64, 32) for i in range(6000)),
                                  rate=10, size=(64, 32), options=_Q | {"g": "50"}), size=(64, 32)),
    # What cannot be used, and what is said.
    Kind(file="unknown.mp4", refused=r"encoded as xyz1, which cannot be decoded here; convert it: ffmpeg",
         make=lambda path: _patched(path, "libx264", b"avc1", b"xyz1")),
    Kind(file="unknown.avi", refused=r"encoded as XYZ1, which cannot be decoded here; convert it: ffmpeg",
         make=lambda path: _patched(path, "mpeg4", b"FMP4", b"XYZ1")),
    Kind(file="cut.mp4", refused="cut off before its index", make=lambda path: _cut(path, "libx264", 0.5)),
    Kind(file="cut-index.mp4", refused=r"breaks off: only \d+ of 60 frames .* --end", make=lambda path: _cut(
        path, "libx264", 0.6, muxing={"movflags": "faststart"}, options=_X264)),
    Kind(file="cut.webm", refused=r"breaks off: only \d+ of 60 frames .* --end", make=lambda path: _cut(
        path, "libvpx", 0.5, options=_VP8)),
    Kind(file="cut.avi", refused=r"breaks off: only \d+ of 60 frames .* --end",
         make=lambda path: _cut(path, "mjpeg", 0.5, pix_fmt="yuvj420p")),
    Kind(file="black.mp4", refused="shows one colour and nothing else", make=lambda path: encode(
        path, "libx264", frames=[np.zeros((64, 96, 3), np.uint8)] * 12)),
    Kind(file="frozen.mp4", refused="shows a still picture", make=lambda path: encode(
        path, "libx264", frames=[numbered(5)] * 12)),
    Kind(file="short.mp4", refused=r"lasts at least 0.3 s.* gives 0.07 s",
         make=lambda path: encode(path, "libx264", frames=2)),
    Kind(file="strip.avi", refused="one side may be at most 40 times the other", make=lambda path: encode(
        path, "mjpeg", frames=12, size=(2048, 16), pix_fmt="yuvj420p")),
    Kind(file="sound.mp4", refused="is sound without a picture", make=lambda path: _only_sound(path)),
    Kind(file="empty.mp4", refused=r"is empty \(0 bytes\)", make=lambda path: path.write_bytes(b"") and None),
    Kind(file="page.mp4", refused="is a web page: download the video itself",
         make=lambda path: path.write_text("<!DOCTYPE html><html><body>Sign in</body></html>") and None),
    Kind(file="playlist.m3u8", refused="is a list of other files",
         make=lambda path: path.write_text("#EXTM3U\n#EXTINF:1.0,\nh264.mp4\n#EXT-X-ENDLIST\n") and None),
    Kind(file="picture.png", refused="at least 2 frames",
         make=lambda path: Image.fromarray(numbered(1)).save(path)),
    # Long ones.
    Kind(file="hour.mp4", long=True, options={"start": 3590.0, "end": 3595.0},
         expected=[k % 1000 for k in range(3590 * 30, 3595 * 30)], size=(64, 32),
         make=lambda path: encode(path, "mpeg4", size=(64, 32), options=_Q,
                                  frames=(numbered(i % 1000, 64, 32) for i in range(108_000)))),
    *(
        Kind(file=f"4k-{name}.mp4", long=True, size=(640, 360), expected=list(range(30)),
             make=lambda path, codec=codec, pix_fmt=pix_fmt: encode(
                 path, codec, frames=(numbered(i, 3840, 2160) for i in range(30)), pix_fmt=pix_fmt,
                 size=(3840, 2160), options={"preset": "ultrafast"}))
        for name, codec, pix_fmt in (("h264", "libx264", "yuv420p"), ("hevc-10bit", "libx265", "yuv420p10le"))
    ),
]  # fmt: skip


# --- comparing ------------------------------------------------------------------------------------


def wrong(kind: Kind, frames: Sequence[np.ndarray]) -> str:
    """What is wrong with the frames that came of a video; nothing if all is well."""
    if not len(frames):
        return "no frames"
    size = frames[0].shape[1::-1]
    corners = sorted({corners_of(frame) for frame in frames})
    numbers = [-1 if kind.expected[0] == -1 else number_of(frame) for frame in frames]
    faults = []
    if numbers != kind.expected:
        faults.append(f"frames {told(numbers)} for {told(kind.expected)}")
    if size != kind.size:
        faults.append(f"{size[0]} x {size[1]} pixels for {kind.size[0]} x {kind.size[1]}")
    if max(combed(frame) for frame in frames) > 30:
        faults.append("two moments in one picture")
    if corners != [kind.corners]:
        faults.append(f"corners {', '.join(corners)} for {kind.corners}")
    return "; ".join(faults)


def told(numbers: Sequence[int]) -> str:
    """A list of frame numbers in short: ``0-11``, ``0x3 1x12``."""
    if numbers and numbers[0] == -1:
        return f"{len(numbers)} frames"
    parts: list[list[int]] = []  # first, last, times each
    for number in numbers:
        if parts and number == parts[-1][1]:
            parts[-1][2] += 1
        else:
            parts.append([number, number, 1])
    short: list[list[int]] = []
    for first, last, times in parts:
        if short and times == short[-1][2] and first == short[-1][1] + 1:
            short[-1][1] = last
        else:
            short.append([first, last, times])
    said = [
        (f"{first}-{last}" if last > first else f"{first}") + (f" x{times}" if times > 1 else "")
        for first, last, times in short
    ]
    return ", ".join(said) if len(said) <= 4 else f"{', '.join(said[:3])} ... {said[-1]}"


def by_ffmpeg(path: Path) -> list[int] | None:
    """The numbers in the order in which an ffmpeg program decodes them; None without one, or if it fails."""
    program = shutil.which("ffmpeg")
    if program is None:
        return None
    form = ["-fps_mode", "passthrough", "-vf", "yadif=deint=interlaced,scale=200:100", "-pix_fmt", "rgb24"]
    done = subprocess.run(
        [program, "-v", "error", "-i", str(path), *form, "-f", "rawvideo", "-"],
        capture_output=True,
        check=False,
    )
    pictures = np.frombuffer(done.stdout, np.uint8)
    pictures = pictures[: len(pictures) // 60000 * 60000].reshape(-1, 100, 200, 3)
    return [number_of(picture) for picture in pictures] or None


def main() -> None:
    """Makes all, brings each in, prints the table; ends with 1 if one is wrong."""
    from onedemo.demos.library import import_video, read_frames
    from onedemo.errors import UserError

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="also those that take minutes")
    parser.add_argument("--only", default="", help="names that contain this")
    parser.add_argument("--keep", type=Path, help="make the files here and leave them")
    wanted = parser.parse_args()
    failed = 0
    ffmpeg = shutil.which("ffmpeg") is not None
    print(f"| file | expected | got |{' ffmpeg |' if ffmpeg else ''}")
    print(f"|---|---|---|{'---|' if ffmpeg else ''}")
    with tempfile.TemporaryDirectory() as place:
        directory = wanted.keep or Path(place)
        directory.mkdir(exist_ok=True)
        for kind in KINDS:
            if (kind.long and not wanted.long) or wanted.only not in kind.file:
                continue
            path = directory / kind.file
            kind.make(path)
            demos = Path(place) / kind.file.replace(".", "-")
            expected = f"refused: {kind.refused}" if kind.refused else told(kind.expected)
            if kind.options:
                expected += f" ({', '.join(f'--{k} {v:g}' for k, v in kind.options.items())})"
            also = ""
            try:
                frames = read_frames(import_video(path, name="x", demos_dir=demos, **kind.options))
                said = "a demo" if kind.refused else wrong(kind, frames)
                got = said or "as expected"
                if ffmpeg and not kind.refused and not kind.options and kind.expected[0] != -1:
                    theirs = by_ffmpeg(path)
                    lacks = sorted({number_of(frame) for frame in frames} - set(theirs or ()))
                    also = f"has no {told(lacks)}" if lacks else "the same pictures"
            except UserError as error:
                got = re.sub(r"\S*/", "", str(error))
                said = "" if kind.refused and re.search(kind.refused, str(error)) else "refused"
                got = got if said else "refused so"
            failed += bool(said)
            mark = "" if not said else " **wrong**"
            print(f"| `{kind.file}` | {expected} | {got}{mark} |{f' {also} |' if ffmpeg else ''}", flush=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
