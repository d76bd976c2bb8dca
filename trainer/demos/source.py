"""A video that comes in, as it is: which picture is on screen when, upright, with square pixels.

Decoded with PyAV (FFmpeg); animated WebP, which FFmpeg cannot decode, with OpenCV. Only the limited child
of ``onedemo.demos.sandboxed_decoder`` and tests use this: what comes in is not trusted.

Shapes: H rows, W columns; pictures are uint8 RGB.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from typing import BinaryIO

import av
import av.error
import av.filter
import av.logging
import cv2
import numpy as np
from av.video.reformatter import Interpolation

from onedemo.demos.containers import CONVERT, missing_bytes
from onedemo.demos.frame_geometry import orientation, pixel_aspect, square_pixels, turned
from onedemo.errors import UserError

FORMATS = (
    "mov,mp4,matroska,webm,avi,gif,mjpeg,mpegts,mpeg,mpegvideo,h264,hevc,flv,asf,ogg,jpeg_pipe,png_pipe,"
    "apng,av1,dv,h263,ivf,m4v,mxf,nut,obu,webp_pipe,yuv4mpegpipe"
)
"""What may be inside. Playlists are left out: they make the decoder open other files and addresses."""
THREADS = 4
"""Of a decoder: fixed, since each takes memory, whatever the machine has of cores."""
_MOST_PIXELS = 4096 * 4096
_SEEK_FROM = 5.0
"""Seconds before the wanted part from which on it is worth seeking."""
_SILENT_ABOUT_TRACKS = ("matroska,webm", "mpegts", "mpeg", "flv", "asf", "ogg")
"""Containers that give a length of the whole, not of the picture."""
_PICTURE_BY_PICTURE = ("apng", "gif")
_SHORTEST_DELAY, _PLAYED_DELAY = 0.0105, 0.1
"""Seconds: browsers take animated pictures that ask for less than the first to mean the second."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A picture and when it comes on screen."""

    seconds: float
    """Since the first picture."""
    picture: Callable[[], np.ndarray]
    """Gives it upright, with square pixels, (H, W, 3), uint8 RGB."""
    lasts: float
    """Seconds by the container's word, 0.0 where it gives none."""


class Source:
    """A video, opened for reading once.

    Args:
        file: Open for reading, and able to seek.
        name: What sentences call it.

    Raises:
        UserError: If it is not a video, or nothing here decodes it.
    """

    width: int
    """Pixels, upright, when they are square."""
    height: int
    """Pixels."""
    fps: float
    """Frames per second by the container, 30 where it names no sensible rate."""
    seconds: float
    """Length by the container, 0.0 where it does not say."""
    whole: int
    """Pictures by the container, also those that it asks to skip; 0 where it does not say."""
    broken: int
    """Pictures that could not be decoded, or only in part, so far."""
    missing: int
    """Bytes that the file lacks by its container's word."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self._name, self.broken, self.whole = name, 0, 0
        self.missing = missing_bytes(file)
        file.seek(0)
        head = file.read(64)
        file.seek(0)
        self._animation: Iterator[Shown] | None = None
        if head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and head[20] & 2:
            self._open_webp(file, head)
            return
        try:
            self._container = av.open(
                _Plain(file), "r", metadata_errors="replace", buffer_size=1 << 18, io_open=_open_nothing,
                options={"max_pixels": str(_MOST_PIXELS), "threads": "1"},
                container_options={"format_whitelist": FORMATS, "protocol_whitelist": "pipe"},
            )  # fmt: skip
        except av.error.MemoryError:
            raise MemoryError from None
        except (av.error.FFmpegError, ValueError, OSError) as error:
            raise self._no_video() from error
        self._stream = self._choose()
        context = self._stream.codec_context
        if context is None:
            raise UserError(f"{name} is encoded as {self._codec()}, which cannot be decoded here; convert "
                            f"it: {CONVERT}")  # fmt: skip
        if context.width < 1 or context.height < 1:
            raise self._no_video()
        context.thread_count = THREADS
        context.thread_type = "AUTO"
        rate = self._stream.average_rate or self._stream.guessed_rate or 0
        self.fps = float(rate) if 0.1 <= rate <= 1000 else 30.0
        self.seconds = self._length()
        self.whole = max(self._stream.frames, round(self.seconds * self.fps))
        self._aspect = pixel_aspect(self._stream.sample_aspect_ratio)
        self._turn = (1, 0, 0, 1)
        self._origin = self._last_end = 0.0
        self._first, self._all = self._open_first()
        self._origin = _stamp(self._first) or 0.0
        width, height = square_pixels(self._first.width, self._first.height, self._aspect)
        self._turn = orientation(self._first)
        self.width, self.height = (width, height) if self._turn[0] else (height, width)

    def frames(self, start: float = 0.0) -> Iterator[Shown]:
        """The pictures in order; those before ``start`` as far as they have to be decoded.

        Time stamps are the container's; one that does not move on (all zero in some AVI and raw streams)
        is replaced by the one before plus a frame at the nominal rate.

        Args:
            start: Seconds; what is on screen then comes, too.
        """
        if self._animation is not None:
            yield from self._animation
            return
        yield from self._timed(self._from(start) if start > _SEEK_FROM else self._all)

    def stays(self) -> float:
        """When the last picture leaves the screen, seconds, as far as the container tells; call it last."""
        if self.missing or self._animation is not None:
            return 0.0
        if self._container.format.name not in _SILENT_ABOUT_TRACKS:
            return 0.0
        track = re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", self._stream.metadata.get("DURATION", ""))
        if track:
            return int(track[1]) * 3600 + int(track[2]) * 60 + float(track[3])
        return max(self._last_end, self.seconds)

    def close(self) -> None:
        """Closes what was opened, but not the file."""
        if self._animation is None:
            self._container.close()

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # --- opening ----------------------------------------------------------------------------------

    def _no_video(self) -> UserError:
        return UserError(
            f"{self._name} is not a video that can be read, or it is cut off before its index; "
            f"give a whole file, or convert it: {CONVERT}"
        )

    def _choose(self) -> av.VideoStream:
        videos = [s for s in self._container.streams.video if not _is_cover(s)]
        if not videos:
            if self._container.streams.audio:
                raise UserError(f"{self._name} is sound without a picture; a demo is made of a video")
            raise self._no_video()
        best = self._container.streams.best("video")
        return best if best in videos else videos[0]  # type: ignore[return-value]

    def _codec(self) -> str:
        """What the container calls the codec for which there is no decoder."""
        level = av.logging.get_level()
        av.logging.set_level(av.logging.INFO)
        try:
            said = self._container.dumps_format()
        finally:
            av.logging.set_level(level)
        found = re.search(r"Video: (\w+)[^\n]*?\((\w{4}) / 0x", said) or re.search(r"Video: (\w+)()", said)
        if not found:
            return "something unknown"
        return found[2] or found[1] if found[1] in ("none", "unknown") else found[1]

    def _length(self) -> float:
        stream, container = self._stream, self._container
        if container.format.name not in _SILENT_ABOUT_TRACKS and stream.duration and stream.time_base:
            seconds = float(stream.duration * stream.time_base)
        else:
            seconds = (container.duration or 0) / 1e6
        return seconds if 0 < seconds < 1e7 else 0.0

    def _open_first(self) -> tuple[av.VideoFrame, Iterator[av.VideoFrame]]:
        """The first picture, and all of them."""
        frames = self._deinterlaced(self._decode())
        first = next(frames, None)
        if first is not None:
            return first, chain((first,), frames)
        if not self.broken:
            raise self._no_video()
        raise UserError(
            f"{self._name} cannot be decoded: its {self._stream.codec_context.name} pictures are damaged; "
            f"convert it: {CONVERT}"
        )

    def _from(self, start: float) -> Iterator[av.VideoFrame]:
        """The pictures from a key frame before ``start`` on, or all of them if there is no getting there."""
        stream = self._stream
        if _stamp(self._first) is None or not stream.time_base:
            return self._all
        with suppress(av.error.FFmpegError):
            for before in (0.0, 10.0):
                wanted = self._origin + max(0.0, start - before)
                self._container.seek(int(wanted / stream.time_base), stream=stream, backward=True)
                frames = self._again()
                first = next(frames, None)
                stamp = None if first is None else _stamp(first)
                if first is not None and stamp is not None and stamp - self._origin <= start + 1e-4:
                    return chain((first,), frames)
        self._container.seek(0)
        return self._again()

    def _again(self) -> Iterator[av.VideoFrame]:
        self._stream.codec_context.flush_buffers()
        self._last_end = 0.0
        return self._deinterlaced(self._decode())

    # --- decoding ---------------------------------------------------------------------------------

    def _decode(self) -> Iterator[av.VideoFrame]:
        """All pictures from here on; what cannot be decoded is counted and left out."""
        try:
            for packet in self._container.demux():
                if packet.stream is not self._stream:
                    if packet.pts is not None and packet.stream.type == "audio":
                        end = float((packet.pts + (packet.duration or 0)) * packet.time_base)
                        self._last_end = max(self._last_end, end - self._origin)
                    continue
                try:
                    yield from self._stream.decode(packet)  # type: ignore[misc]
                except av.error.EOFError:
                    return
                except av.error.MemoryError:
                    raise MemoryError from None
                except av.error.FFmpegError:
                    self.broken += 1
        except (av.error.FFmpegError, OSError):  # the container breaks off
            try:
                yield from self._stream.decode(None)  # type: ignore[misc]
            except av.error.FFmpegError:
                pass

    def _deinterlaced(self, frames: Iterator[av.VideoFrame]) -> Iterator[av.VideoFrame]:
        """The same pictures, from the first that holds two moments on each turned into one moment."""
        graph, form = None, None
        while (frame := next(frames, None)) is not None:
            self.broken += frame.is_corrupt
            now = (frame.width, frame.height, frame.format.name)
            if graph is not None and now != form:
                yield from _rest(graph)
                graph = None
            if graph is None and frame.interlaced_frame:
                graph, form = _deinterlacer(frame, self._stream.time_base), now
                # What moves is told by the picture before; the first of all is given the one after.
                if (after := next(frames, None)) is not None:
                    frames = chain((after,), frames)
                    if (after.width, after.height, after.format.name) == form:
                        graph.vpush(after)
                        graph.vpush(frame)
                        graph.vpull()
                        continue
            if graph is None:
                yield frame
            else:
                graph.vpush(frame)
                yield from _ready(graph)
        if graph is not None:
            yield from _rest(graph)

    def _timed(self, frames: Iterator[av.VideoFrame]) -> Iterator[Shown]:
        last, follows = None, 0.0
        period = 1 / self.fps
        by_picture = self._container.format.name in _PICTURE_BY_PICTURE
        for frame in frames:
            stamp = _stamp(frame)
            lasts = float(frame.duration * frame.time_base) if frame.duration and frame.time_base else 0.0
            if by_picture and lasts < _SHORTEST_DELAY:
                lasts = _PLAYED_DELAY
            seconds = follows if stamp is None or by_picture else stamp - self._origin
            if last is not None and seconds <= last + 1e-4:
                seconds = follows
            last, follows = seconds, seconds + (lasts if by_picture else period)
            yield Shown(seconds, lambda frame=frame: self._upright(frame), lasts)

    def _upright(self, frame: av.VideoFrame) -> np.ndarray:
        picture = frame.to_ndarray(
            format="rgb24", threads=1,
            interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.BITEXACT,
        )  # fmt: skip
        size = square_pixels(self._first.width, self._first.height, self._aspect)
        if size != picture.shape[1::-1]:  # also one whose size changes on the way
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        return turned(picture, self._turn)

    def _open_webp(self, file: BinaryIO, head: bytes) -> None:
        self.width = int.from_bytes(head[24:27], "little") + 1
        self.height = int.from_bytes(head[27:30], "little") + 1
        if self.width * self.height > _MOST_PIXELS:
            self._animation, self.fps, self.seconds = iter(()), 30.0, 0.0
            return
        done, animation = cv2.imdecodeanimation(np.frombuffer(file.read(), np.uint8)[None])
        if not done or not len(animation.frames):
            raise UserError(
                f"{self._name} cannot be decoded: its webp pictures are damaged; convert it to mp4"
            )
        delays = [delay / 1000 for delay in animation.durations]
        delays = [_PLAYED_DELAY if delay < _SHORTEST_DELAY else delay for delay in delays]
        times = np.concatenate([[0.0], np.cumsum(delays)[:-1]])
        self.seconds = float(sum(delays))
        self.fps = len(delays) / self.seconds
        self._animation = (
            Shown(float(at), lambda frame=frame: cv2.cvtColor(frame[..., :3], cv2.COLOR_BGR2RGB), lasts)
            for at, frame, lasts in zip(times, animation.frames, delays, strict=True)
        )


class _Plain:
    """A file without its name: a decoder judges by the content, and opens nothing beside it."""

    name = ""

    def __init__(self, file: BinaryIO) -> None:
        self.read, self.seek, self.tell = file.read, file.seek, file.tell


def _open_nothing(url: str, flags: int, options: dict) -> None:
    raise PermissionError(os.strerror(13))


def _is_cover(stream: av.VideoStream) -> bool:
    """Whether it is the picture on a sleeve."""
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _stamp(frame: av.VideoFrame) -> float | None:
    stamp = frame.pts if frame.pts is not None else frame.dts
    return None if stamp is None or not frame.time_base else float(stamp * frame.time_base)


def _deinterlacer(frame: av.VideoFrame, time_base: Fraction | None) -> av.filter.Graph:
    graph = av.filter.Graph()
    graph.threads = 1
    entry = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=time_base or Fraction(1, 90000)
    )
    mend = graph.add("bwdif", "mode=send_frame:parity=auto:deint=interlaced")
    graph.link_nodes(entry, mend, graph.add("buffersink")).configure()
    return graph


def _ready(graph: av.filter.Graph) -> Iterator[av.VideoFrame]:
    while True:
        try:
            yield graph.vpull()
        except (av.error.BlockingIOError, av.error.EOFError):
            return


def _rest(graph: av.filter.Graph) -> Iterator[av.VideoFrame]:
    graph.vpush(None)
    yield from _ready(graph)
