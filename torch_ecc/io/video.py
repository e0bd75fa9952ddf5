"""Video files, through PyAV: the luma plane as it was coded, of 8 to 16 bits, at the times that the container gives."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import av
import cv2
import numpy as np
from av.video.plane import VideoPlane
from av.video.reformatter import ColorRange, VideoReformatter

from torch_ecc.io.frames import FrameError, Medium, Pixels, Raw, brief, check_size
from torch_ecc.io.jpeg import Jpeg, Tint, grey, is_plain

_KINDS = "3gp asf avi dv flv h264 hevc ivf m2ts m4v mjpeg mjpg mkv mov mp4 mpeg mpg mts mxf nut ogv ts vob webm wmv y4m"
VIDEOS = frozenset(f".{kind}" for kind in _KINDS.split())
_SLACK_FRAMES, _SLACK = 3, 0.02
_STRICT = {"err_detect": "explode"}  # a frame that is damaged is told, and not made up from its neighbours
_FROM_ZERO = ("matroska,webm", "nut", "asf")  # that declare when they end, and not how long they last
_WIDENED = ("gray16le", "gray16be")
_IMAGES = ("tiff_pipe", "webp_pipe")
_COVER = 1024  # in the disposition of a stream: the picture on the sleeve of a sound
_PACKED = {"yuyv422": 0, "yvyu422": 0, "uyvy422": 1}  # where the first luma byte stands among chroma bytes

_PLANAR = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p")
_NEUTRAL = 127, 129  # chroma within that, as coders round it, is grey

_conversion = threading.local()  # to colours: made once for a thread, and not, six times as dear, for each frame

_Decoded: TypeAlias = "av.VideoFrame | Jpeg | str"


class _Way(NamedTuple):
    """How a file is decoded: FFmpeg's ``options``, the size of frames of motion JPEG that are ``plain``, and the bits
    by which FFmpeg has ``widened`` raw levels."""

    options: dict[str, str]
    plain: tuple[int, int] | None
    widened: int


def open_video(path: Path) -> Medium:
    """The frames of a video file; ``length`` and ``fps`` as its container declares them. ValueError if it has none."""
    with _opened(path, _STRICT) as (container, stream):
        check_size(f"open_frames: {path}", stream.width, stream.height)
        fps, length = _rate(container, stream), _declared(container, stream)
        ratio, others = stream.sample_aspect_ratio or 1, len(container.streams.video) - 1
        bits = stream.codec_context.bits_per_coded_sample if stream.codec_context.name == "rawvideo" else 0
        widened = 16 - bits if stream.codec_context.pix_fmt in _WIDENED and 8 < bits < 16 else 0
        first = next((frame for _, frame in _decoded(container, stream)), "")
    # Some writers never close an image as their standard wants it: a decoder that is strict would refuse every frame.
    way = _Way({} if isinstance(first, str) else _STRICT, _plain_size(path), widened)
    uneven = f"{path.name}: its pixels are not square, they are {float(ratio):.4g} times as wide as high"
    beside = f"{path.name}: of its {others + 1} videos the one of {stream.width} x {stream.height} px is read"
    notes = (uneven,) * (ratio != 1) + (beside,) * (others > 0)
    return Medium(lambda numbers: _read(path, way, numbers), length or None, fps, notes=notes, exact=False)


@contextmanager
def _opened(path: Path, options: dict[str, str]) -> Iterator[tuple[Any, Any]]:
    """The container and its video stream."""
    try:
        container = av.open(str(path.absolute()))  # of other names what stands before a colon would be a protocol
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or brief(error)
        raise ValueError(f"open_frames: {path} cannot be opened as a video ({reason})") from error
    with container:
        if container.format.name in _IMAGES:  # of which FFmpeg would read the first one only
            raise ValueError(f"open_frames: {path} is an image ({container.format.name[:4]}), give it such a name")
        stream = container.streams.best("video")
        if stream is None or stream.codec_context is None or stream.disposition.value & _COVER:
            raise ValueError(f"open_frames: {path} holds no video that can be decoded")
        stream.codec_context.options = options
        yield container, stream


def _rate(container: Any, stream: Any) -> float | None:
    """Frames per second, None where the format has no clock: FFmpeg then assumes one."""
    rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate and not container.format.flags & av.format.Flags.no_timestamps.value else None


def _declared(container: Any, stream: Any) -> int:
    """How many frames the container says it shows, 0 if it does not."""
    begun = (container.start_time or 0) if container.format.name in _FROM_ZERO else 0
    fps, seconds = _rate(container, stream), max((container.duration or 0) - begun, 0) / av.time_base
    frames = int(stream.frames)
    by_time = round(seconds * fps) if fps else 0
    if not frames:
        return by_time if len(container.streams) == 1 else 0  # the duration may be that of a longer sound
    # Of MP4 and its kin a trim only hides frames, which are counted all the same.
    return min(frames, by_time or frames) if "mp4" in container.format.name else frames


def _plain_size(path: Path) -> tuple[int, int] | None:
    """Width and height of frames of motion JPEG that libjpeg reads as FFmpeg does, None of all others."""
    with _opened(path, {}) as (container, stream), suppress(av.FFmpegError):
        packets = container.demux(stream) if stream.codec_context.name == "mjpeg" else ()
        for packet in packets:
            for frame in packet.decode():
                return (frame.width, frame.height) if is_plain(packet, frame) else None
    return None


def _read(path: Path, way: _Way, numbers: range) -> Iterator[Raw]:
    with _opened(path, way.options) as (container, stream):
        fps, count, last = _rate(container, stream), 0, 0.0
        for time_s, frame in _decoded(container, stream, way.plain):
            if count >= numbers.stop:
                return
            last = time_s if time_s is not None and fps else (count / fps if fps else 0.0)
            if count in numbers:
                yield _raw(count, frame, last if fps else None, way.widened)
            count += 1
        # Counted in time and with some slack: what containers declare is exact for some and an estimate for others.
        declared, start = _declared(container, stream), float((stream.start_time or 0) * (stream.time_base or 0))
        missing = declared - 1 - (last - start) * fps if fps and last > start else declared - count
        if missing > max(_SLACK_FRAMES, _SLACK * declared) and declared > count:
            reason = f"{path.name} ends here, but declares {declared} frames: it is cut off or damaged"
            raise FrameError(count, reason)


def _decoded(
    container: Any, stream: Any, plain: tuple[int, int] | None = None
) -> Iterator[tuple[float | None, _Decoded]]:
    """Time and frame, or the reason why there is none, in the order of their times. A damaged frame takes those with it
    that are predicted from it, up to the next one that stands by itself."""
    damaged: list[tuple[float, str]] = []
    tainted, tint = False, Tint()
    # AVI tells when frames are decoded and not when they are shown; FFmpeg guesses that, up to one dropped frame off.
    # The k-th frame to be shown is so at the k-th of these times.
    slots: deque[float] = deque()
    guessed = container.format.name == "avi"
    try:
        for packet in container.demux(stream):
            if packet.size == 0 and packet.dts is not None:
                continue  # a dropped frame: its time passes, and there is nothing to decode
            if guessed and packet.dts is not None:
                slots.append(float(packet.dts * packet.time_base))
            try:
                found = None if plain is None else grey(packet, *plain, tint)
                frames = packet.decode() if found is None else [found]
            except av.FFmpegError as error:
                when = float((packet.pts or 0) * packet.time_base) if not slots else slots.pop()
                damaged.append((when, f"it cannot be decoded ({error.strerror})"))
                tainted = True
                continue
            for frame in frames:
                time = slots.popleft() if slots else frame.time
                while damaged and time is not None and damaged[0][0] < time:
                    yield damaged.pop(0)
                tainted = frame.is_corrupt or (tainted and not frame.key_frame)
                yield time, "it is damaged, or predicted from a frame that is" if tainted else frame
    except av.FFmpegError as error:
        damaged.append((damaged[-1][0] if damaged else 0.0, f"the file is damaged from here on ({error.strerror})"))
    yield from damaged


def _raw(number: int, frame: _Decoded, time_s: float | None, widened: int) -> Raw:
    if isinstance(frame, str):
        return Raw(number, frame, time_s)
    if isinstance(frame, Jpeg):
        return Raw(number, frame.pixels, time_s, colours=frame.colours if frame.coloured else None)
    gray = _luma(frame)
    if gray is None:
        return Raw(number, _upright(_rgb(frame), frame), time_s)
    colours = (lambda: _upright(_shown(frame), frame)) if len(frame.format.components) > 1 else None
    return Raw(number, _upright(gray >> widened if widened else gray, frame), time_s, colours=colours)


def _upright(pixels: Pixels, frame: av.VideoFrame) -> Pixels:
    """Turned and mirrored as the file wants it shown, by quarters of a turn."""
    told: Any = frame.side_data.get("DISPLAYMATRIX")
    if told is None:
        return pixels
    (a, b, _), (c, d, _), _ = np.frombuffer(told, np.int32).reshape(3, 3).tolist()  # x' = a x + c y, y' = b x + d y
    if abs(b) > abs(a):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def _luma(frame: av.VideoFrame) -> Pixels | None:
    """Grey levels (H, W) in memory of their own as they are coded, None where they first have to be made."""
    form, plane = frame.format, frame.planes[0]
    first, *others = form.components
    packed = _PACKED.get(form.name)
    if plane.line_size < 0:  # the last row comes first: a conversion turns that over, if it is to another format
        if others:
            return None
        turned = _luma(frame.reformat(format="gray16le" if first.bits == 8 else "gray16be"))
        return (turned >> 8).astype(np.uint8) if turned is not None and first.bits == 8 else turned
    plain = first.is_luma and not (form.has_palette or form.is_bit_stream or any(each.plane == 0 for each in others))
    if packed is None and not (plain and 8 <= first.bits <= 16):
        return None
    dtype = "u1" if first.bits == 8 else ">u2" if form.is_big_endian else "<u2"
    rows: Pixels = np.ndarray((frame.height, plane.line_size // np.dtype(dtype).itemsize), dtype, memoryview(plane))
    return rows[:, : frame.width].copy() if packed is None else rows[:, packed : 2 * frame.width : 2].copy()


def _shown(frame: av.VideoFrame) -> Pixels:
    """The picture, (H, W, 3), or (H, W) where all of its colours are grey, as of most cameras that measure."""
    if frame.format.name not in _PLANAR or frame.planes[0].line_size < 0:
        return _rgb(frame)
    luma, *chroma = (_bytes(plane) for plane in frame.planes)
    least, most = _NEUTRAL
    if any(plane.min() < least or plane.max() > most for plane in chroma):
        return _rgb(frame)
    if frame.format.name.startswith("yuvj") or frame.color_range == ColorRange.JPEG:
        return luma
    above: Any = 16.0
    return cv2.convertScaleAbs(cv2.subtract(luma, above), alpha=255 / 219)  # of luma from 16 to 235


def _bytes(plane: VideoPlane) -> Pixels:
    """The pixels (h, w) of a plane of bytes, where they are."""
    rows: Pixels = np.ndarray((plane.height, plane.width), np.uint8, memoryview(plane), 0, (plane.line_size, 1))
    return rows


def _rgb(frame: av.VideoFrame) -> Pixels:
    """(H, W, 3), of 16 bits where the frame has more than 8."""
    # Of a Bayer pattern each colour has its share of the bits.
    bits = [each.bits for each in frame.format.components]
    deep = (sum(bits) if frame.format.is_bayer else max(bits)) > 8
    if not hasattr(_conversion, "own"):
        _conversion.own = VideoReformatter()
    made: av.VideoFrame = _conversion.own.reformat(frame, format="rgb48le" if deep else "rgb24")
    return made.to_ndarray()
