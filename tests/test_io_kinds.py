"""Files as microscopes, machine-vision cameras and their programs write them: what is time, what is a level, what is
neither. Every file shows the same six frames, unless it says otherwise."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import av
import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from torch_ecc.io import FrameError, open_frames

Writer: TypeAlias = Callable[[Path], object]

EVEN, UNEVEN = (0, 33, 67, 100, 133, 167), (0, 33, 67, 900, 1200, 1500)  # ms


def speckle() -> np.ndarray:
    """(6, 48, 70) uint16 of all levels, moving by (1.5, -0.75) px a frame."""
    rng = np.random.default_rng(0)
    places, widths, heights = rng.uniform(-10, 80, (150, 2)), rng.uniform(1, 2.5, 150), rng.uniform(2000, 12000, 150)
    y, x = np.mgrid[:48, :70]
    frames = []
    for k in range(6):
        squared = [(x - a - 1.5 * k) ** 2 + (y - b + 0.75 * k) ** 2 for a, b in places]
        spots = zip(squared, widths, heights, strict=True)
        frames.append(3000 + sum(height * np.exp(-far / (2 * width**2)) for far, width, height in spots))
    return np.clip(frames, 0, 65535).astype(np.uint16)


WIDE = speckle()
NARROW = (WIDE >> 8).astype(np.uint8)


class Kind(NamedTuple):
    """What is written, what it shows to within ``loss`` levels, its times in s, and what has to be chosen of it, by the
    names of what it is refused for."""

    write: Writer
    levels: np.ndarray
    times: tuple[float, ...] | None = None
    choice: dict[str, int] = {}  # noqa: RUF012 - nothing writes into it
    loss: float = 0
    um_per_px: float | None = None


def tiff(data: np.ndarray, **options: Any) -> Writer:
    return lambda path: tifffile.imwrite(path, data, **{"photometric": "minisblack"} | options)


def turned(path: Path) -> None:
    """With the tag by which a viewer turns pages by a quarter: the levels are as they are stored."""
    with tifffile.TiffWriter(path) as writer:
        for frame in NARROW:
            writer.write(frame, photometric="minisblack", extratags=[(274, "H", 1, 6, True)], metadata=None)


def video(frames: np.ndarray, pixel: str, codec: str, times_ms: tuple[int, ...], **options: str) -> Writer:
    def write(path: Path) -> None:
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=30, options=options)
            stream.width, stream.height, stream.pix_fmt = 70, 48, pixel
            stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
            for time_ms, frame in zip(times_ms, frames, strict=True):
                image = picture(frame, pixel)
                image.pts, image.time_base = time_ms, Fraction(1, 1000)
                container.mux(stream.encode(image))
            container.mux(stream.encode())

    return write


def picture(frame: np.ndarray, pixel: str) -> av.VideoFrame:
    """As it is coded: the levels are the luma."""
    if pixel == "yuv420p":
        grey = np.full((len(frame) // 2, frame.shape[1]), 128, np.uint8)
        return av.VideoFrame.from_ndarray(np.concatenate((frame, grey)), format=pixel)
    stored = av.VideoFrame.from_ndarray(frame, format="gray16le" if frame.dtype == np.uint16 else "gray")
    return stored.reformat(format=pixel)


def animated(**options: Any) -> Writer:
    first, *others = map(Image.fromarray, NARROW)
    return lambda path: first.save(path, save_all=True, append_images=others, **options)


def uncommon(delays_ms: tuple[int, ...]) -> tuple[float, ...]:
    return tuple(sum(delays_ms[:k]) / 1000 for k in range(len(delays_ms)))


def beside(*others: np.ndarray) -> np.ndarray:
    return np.stack([WIDE, *others], 1)


DELAYS = (50, 70, 10, 50, 200, 50)
NEGATIVE = 65535 - WIDE[::-1]
THREE = np.moveaxis(np.repeat(WIDE[..., None], 3, -1), -1, 1).copy()
SECONDS, UNEVEN_SECONDS = tuple(t / 1000 for t in EVEN), tuple(t / 1000 for t in UNEVEN)
OME = {"PhysicalSizeX": 275.0, "PhysicalSizeXUnit": "nm", "PhysicalSizeY": 0.3, "PhysicalSizeYUnit": "µm"}
PLANES = {"DeltaT": [0.1 * k + 0.01 * c for k in range(6) for c in range(2)]}

KINDS = {
    "channels.tif": Kind(
        tiff(beside(NEGATIVE), imagej=True, metadata={"axes": "TCYX"}), NEGATIVE, choice={"channel": 1}
    ),
    "slices.tif": Kind(
        tiff(beside(NEGATIVE, NEGATIVE), imagej=True, metadata={"axes": "TZYX"}), WIDE, choice={"slice": 0}
    ),
    "channels.ome.tif": Kind(
        tiff(beside(NEGATIVE), metadata={"axes": "TCYX", **OME, "Plane": PLANES}),
        NEGATIVE,
        tuple(0.1 * k + 0.01 for k in range(6)),
        {"channel": 1},
        um_per_px=0.275,
    ),
    "all.ome.tif": Kind(
        tiff(
            np.stack([beside(NEGATIVE), beside(WIDE)], 2),
            metadata={"axes": "TCZYX", "TimeIncrement": 40.0, "TimeIncrementUnit": "ms"},
        ),
        WIDE,
        tuple(0.04 * k for k in range(6)),
        {"channel": 1, "slice": 1},
    ),
    "samples.tif": Kind(tiff(np.stack([WIDE, NEGATIVE], -1), planarconfig="contig"), NEGATIVE, choice={"channel": 1}),
    "interval.tif": Kind(
        tiff(
            WIDE,
            imagej=True,
            resolution=(1 / 0.275, 1 / 0.275),
            metadata={"axes": "TYX", "unit": "um", "finterval": 0.05},
        ),
        WIDE,
        tuple(0.05 * k for k in range(6)),
        um_per_px=0.275,
    ),
    "planar.tif": Kind(tiff(THREE, photometric="rgb", planarconfig="separate"), WIDE),
    "signed.tif": Kind(tiff((NARROW.astype(np.int16) - 128).astype(np.int8)), NARROW.astype(float) - 128),
    "half.tif": Kind(tiff((WIDE / 65535).astype(np.float16)), (WIDE / 65535).astype(np.float16)),
    "wide.tif": Kind(tiff(WIDE.astype(">u4"), byteorder=">"), WIDE),
    "jpeg2000.tif": Kind(tiff(NARROW, compression="jpeg2000"), NARROW),
    "lzw.tif": Kind(tiff(WIDE, compression="lzw", predictor=True), WIDE),
    "one_page.tif": Kind(tiff(NARROW, truncate=True), NARROW),
    "turned.tif": Kind(turned, NARROW),
    "deep.mkv": Kind(video(WIDE, "gray16le", "ffv1", EVEN), WIDE, SECONDS),
    "twelve_bits.mkv": Kind(video(WIDE, "gray12le", "ffv1", EVEN), WIDE // 16, SECONDS, loss=1),
    "uneven.mkv": Kind(video(NARROW, "gray", "ffv1", UNEVEN), NARROW, UNEVEN_SECONDS),
    "uneven.mp4": Kind(video(NARROW, "yuv420p", "libx264", UNEVEN, crf="1"), NARROW, UNEVEN_SECONDS, loss=4),
    "av1.mp4": Kind(video(NARROW, "yuv420p", "libsvtav1", EVEN, crf="5"), NARROW, SECONDS, loss=16),
    "animated.png": Kind(animated(duration=DELAYS), NARROW, uncommon(DELAYS)),
    "animated.webp": Kind(animated(duration=DELAYS, lossless=True), NARROW, uncommon(DELAYS)),
    "animated.gif": Kind(animated(duration=DELAYS), NARROW, uncommon(DELAYS)),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_is_read_right(tmp_path, name):
    kind, path = KINDS[name], tmp_path / name
    if name in ("jpeg2000.tif", "lzw.tif"):
        pytest.importorskip("imagecodecs")
    if name == "av1.mp4" and "libsvtav1" not in av.codecs_available:
        pytest.skip("no encoder of AV1")
    try:
        kind.write(path)
    except av.FFmpegError as error:
        pytest.skip(f"not written by this encoder: {error}")
    source = open_frames(path, **kind.choice)
    frames = list(source)
    assert [frame.damage for frame in frames] == [None] * 6
    found = np.stack([frame.pixels.numpy() for frame in frames]).astype(float)
    assert np.abs(found - kind.levels.astype(float)).max() <= kind.loss
    assert [frame.time_s for frame in frames] == (
        [None] * 6 if kind.times is None else pytest.approx(kind.times, abs=1e-9)
    )
    assert source.timed == (kind.times is not None)
    assert (source.um_per_px or (None,))[0] == pytest.approx(kind.um_per_px)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.choice])
def test_what_is_no_time_is_refused_with_its_name(tmp_path, name):
    kind, path = KINDS[name], tmp_path / name
    kind.write(path)
    with pytest.raises(ValueError, match="which are not time") as caught:
        open_frames(path)
    for axis in kind.choice:
        assert f"2 {axis}s" in str(caught.value) or f"3 {axis}s" in str(caught.value)
        assert f"--{axis} 0..." in str(caught.value)
        with pytest.raises(ValueError, match=rf"{axis}: {name} holds [23] {axis}s, 0 to [12], got 7"):
            open_frames(path, **kind.choice | {axis: 7})


@pytest.mark.parametrize("name", ["animated.png", "deep.mkv", "turned.tif"])
def test_a_choice_of_what_is_not_there_is_refused(tmp_path, name):
    KINDS[name].write(tmp_path / name)
    assert len(list(open_frames(tmp_path / name, channel=0))) == 6
    with pytest.raises(ValueError, match=f"slice: {name} holds one slice, 0, got 2"):
        open_frames(tmp_path / name, slice=2)


def test_stage_positions_of_an_ome_file(tmp_path):
    with tifffile.TiffWriter(tmp_path / "s.ome.tif") as writer:
        for frames in (WIDE, NEGATIVE, WIDE[:, ::-1]):
            writer.write(frames, photometric="minisblack", metadata={"axes": "TYX"})
    with pytest.raises(
        ValueError, match=r"3 positions, which are not time \(P 3 x T 6\): choose with --position 0...2"
    ):
        open_frames(tmp_path / "s.ome.tif")
    for position, frames in enumerate((WIDE, NEGATIVE, WIDE[:, ::-1])):
        found = [frame.pixels.numpy() for frame in open_frames(tmp_path / "s.ome.tif", position=position)]
        np.testing.assert_array_equal(found, frames)


def test_slices_of_imagej_alone_are_taken_for_times_and_that_is_said(tmp_path):
    """ImageJ calls every stack that is not told otherwise slices, that of a video too."""
    tifffile.imwrite(
        tmp_path / "s.tif",
        WIDE,
        photometric="minisblack",
        metadata=None,
        description="ImageJ=1.54f\nimages=6\nslices=6\n",
    )
    source = open_frames(tmp_path / "s.tif")
    assert len(source) == 6
    assert source.notes == ("s.tif: its 6 slices, as ImageJ calls them, are taken for times",)
    tifffile.imwrite(tmp_path / "z.ome.tif", WIDE, photometric="minisblack", metadata={"axes": "ZYX"})
    with pytest.raises(ValueError, match="6 slices, which are not time"):
        open_frames(tmp_path / "z.ome.tif")


def test_axes_without_names_are_refused(tmp_path):
    tifffile.imwrite(tmp_path / "s.tif", beside(NEGATIVE), photometric="minisblack")
    with pytest.raises(ValueError, match=r"axes of unknown meaning \(Q 6 x Q 2\): name them, one of them T"):
        open_frames(tmp_path / "s.tif")


# ---- folders -------------------------------------------------------------------------------------------------------


def folder(path: Path, *names: str) -> Path:
    path.mkdir()
    for name, frame in zip(names, WIDE, strict=False):
        assert cv2.imwrite(str(path / name), frame)
    return path


def test_a_folder_named_by_digits_is_a_folder(tmp_path, monkeypatch):
    folder(tmp_path / "20240501", "f0.png", "f1.png")
    monkeypatch.chdir(tmp_path)
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in open_frames("20240501")], WIDE[:2])


@pytest.mark.parametrize(
    "names",
    [
        ("t_0s.png", "t_0.5s.png", "t_1s.png", "t_1.5s.png", "t_10s.png"),
        ("2024.5.1.png", "2024.5.2.png", "2024.5.10.png", "2024.10.1.png"),
        ("cam1.8.png", "cam1.9.png", "cam1.10.png", "cam1.11.png"),
        ("a2.png", "A10.png", "b1.png"),
        ("x²1.png", "x²2.png", "x²10.png"),
    ],
)
def test_files_are_read_in_the_order_of_their_numbers(tmp_path, names):
    source = open_frames(folder(tmp_path / "f", *names))
    assert source.named
    assert [frame.name for frame in source] == list(names)
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in source], WIDE[: len(names)])


def test_the_content_says_what_an_image_is_and_not_its_name(tmp_path):
    """16 bits of a PNG that is called .jpg are no JPEG's eight."""
    folder(tmp_path / "f", "f0.png", "f1.png")
    for name in ("f0", "f1"):
        (tmp_path / "f" / f"{name}.png").rename(tmp_path / "f" / f"{name}.jpg")
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in open_frames(tmp_path / "f")], WIDE[:2])


@pytest.mark.parametrize(
    ("names", "missing"),
    [
        (("f001.png", "f002.png", "f006.png"), "f003 to f005"),
        (("f00.png", "f10.png", "f20.png", "f40.png"), "f30"),
        (("a_1_x.png", "a_2_x.png", "a_4_x.png", "a_7_x.png"), "a_3_x, a_5_x to a_6_x"),
        (("f1.png", "f2.png", "f3.png"), None),
        (("a1.png", "b7.png", "c9.png"), None),
    ],
)
def test_gaps_in_the_numbering_are_told(tmp_path, names, missing):
    notes = open_frames(folder(tmp_path / "f", *names)).notes
    assert notes == (() if missing is None else (f"missing in the numbering of the files: {missing}",))


def test_a_rate_given_wins_over_the_times_of_the_file(tmp_path):
    KINDS["uneven.mkv"].write(tmp_path / "v.mkv")
    source = open_frames(tmp_path / "v.mkv", fps=100.0)
    assert source.fps == 100
    assert [frame.time_s for frame in source] == pytest.approx([k / 100 for k in range(6)])
    with pytest.raises(ValueError, match="fps must be a rate > 0 in Hz, got -1"):
        open_frames(tmp_path / "v.mkv", fps=-1.0)


@pytest.mark.parametrize("codec", ["mjpeg", "mpeg4", "libx264"])
def test_frames_that_an_avi_has_dropped_leave_their_time(tmp_path, codec):
    shown, pixel = (0, 1, 2, 27, 36, 45), "yuvj420p" if codec == "mjpeg" else "yuv420p"
    with av.open(str(tmp_path / "v.avi"), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 70, 48, pixel
        stream.codec_context.time_base = Fraction(1, 30)
        for time, frame in zip(shown, NARROW, strict=True):
            image = picture(frame, "yuv420p").reformat(format=pixel)
            image.pts, image.time_base = time, Fraction(1, 30)
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    assert [frame.time_s for frame in open_frames(tmp_path / "v.avi")] == pytest.approx([t / 30 for t in shown])


def test_a_longer_sound_is_no_missing_frame(tmp_path):
    """A container without a count of frames only tells how long the longest of its streams lasts."""
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        picture_stream, sound = container.add_stream("ffv1", rate=20), container.add_stream("pcm_s16le", rate=8000)
        picture_stream.width, picture_stream.height, picture_stream.pix_fmt = 70, 48, "gray"
        for frame in NARROW:
            container.mux(picture_stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        container.mux(picture_stream.encode())
        for k in range(5):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), format="s16", layout="mono")
            silence.sample_rate, silence.pts, silence.time_base = 8000, 8000 * k, Fraction(1, 8000)
            container.mux(sound.encode(silence))
        container.mux(sound.encode())
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in open_frames(tmp_path / "v.mkv")], NARROW)


def test_a_turned_video_is_seen_as_it_is_shown(tmp_path):
    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=20, options={"crf": "1"})
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this PyAV writes no rotation")
        stream.width, stream.height, stream.pix_fmt = 70, 48, "yuv420p"
        stream.set_display_rotation(90)  # counter-clockwise
        for frame in NARROW:
            container.mux(stream.encode(picture(frame, "yuv420p")))
        container.mux(stream.encode())
    source = open_frames(tmp_path / "v.mp4")
    assert source.shape == (70, 48)
    for frame, stored in zip(source, NARROW, strict=True):
        assert np.abs(np.rot90(stored).astype(int) - frame.pixels.numpy()).max() <= 4
        assert frame.picture().shape[-2:] == (70, 48)


CINE_HEAD = "<2s3HiIiI3IQ"


PHANTOM = {
    "8 bits": (NARROW, 8, (0, 0)),
    "16 bits": (WIDE, 16, (0, 0)),
    "12 bits": (WIDE >> 4, 12, (0, 0)),
    "mirrored": (WIDE, 16, (1, 0)),
    "turned over": (NARROW, 8, (1, 1)),
}


@pytest.mark.parametrize("name", PHANTOM)
def test_phantom_frames_have_the_times_and_levels_of_their_own(tmp_path, name):
    """The camera ran at 90 kHz, and every tenth frame was saved: 0.3 s before the trigger. Its user may have asked for
    the picture to be flipped from left to right, or from top to bottom, or both."""
    levels, bits, (across, down) = PHANTOM[name]
    setup, blocks, count, depth = 44 + 40, 44 + 40 + 6000, 6, levels.itemsize
    trigger = (1_700_000_000 << 32) + (1 << 31)
    times = [trigger + round((k / 9000 - 0.3) * 2**32) for k in range(count)]
    images = blocks + 8 + 8 * count + 8 * count
    head = struct.pack(CINE_HEAD, b"CI", 44, 0, 1, 0, count, 0, count, 44, setup, images - 8 * count, trigger)
    bitmap = struct.pack("<IiiHHIIiiII", 40, 70, 48, 1, 8 * depth, 0, depth * 70 * 48, 0, 0, 0, 1 << bits)
    told = bytearray(6000)
    struct.pack_into("<H", told, 0, 9000)
    struct.pack_into("<2sH", told, 140, b"ST", 6000)
    struct.pack_into("<2i", told, 756, across, down)
    struct.pack_into("<I", told, 896, bits)
    block = struct.pack(f"<IHH{count}Q", 8 + 8 * count, 1002, 0, *times)
    size = 8 + depth * 70 * 48
    offsets = struct.pack(f"<{count}Q", *(images + k * size for k in range(count)))
    frames = b"".join(struct.pack("<II", 8, depth * 70 * 48) + frame[::-1].tobytes() for frame in levels)
    (tmp_path / "v.cine").write_bytes(head + bitmap + told + block + offsets + frames)
    source = open_frames(tmp_path / "v.cine")
    assert source.fps == pytest.approx(9000, rel=1e-6)
    assert [frame.time_s for frame in source] == pytest.approx([k / 9000 - 0.3 for k in range(count)], abs=1e-9)
    shown = levels[:, :: 1 - 2 * down, :: 1 - 2 * across]
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in source], shown)


# ---- damage and attacks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["channels.tif", "slices.tif", "interval.tif", "one_page.tif"])
def test_what_is_left_of_a_stack_that_was_cut_off_is_read(tmp_path, name):
    """Its list of pages, which comes last, is gone, but not its first frames; channels are no time even so."""
    kind, path = KINDS[name], tmp_path / name
    kind.write(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    if kind.choice:
        with pytest.raises(ValueError, match="which are not time"):
            open_frames(path)
    found = []

    def read_all() -> None:
        for frame in open_frames(path, **kind.choice):
            found.append(frame.pixels.numpy())  # noqa: PERF401, those before the error are wanted

    with pytest.raises(FrameError, match="ends here, but more was promised"):
        read_all()
    assert 2 < len(found) < 5
    np.testing.assert_array_equal(found, kind.levels[: len(found)])


def claim(path: Path, side: int) -> None:
    """A small file whose header says that its frames are so many px high and wide."""
    if path.suffix == ".png":
        chunks = {b"IHDR": struct.pack(">II5B", side, side, 8, 0, 0, 0, 0), b"IDAT": zlib.compress(bytes(100))}
        framed = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks.items())
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(framed))
    elif path.suffix == ".npy":
        head = f"{{'descr': '|u1', 'fortran_order': False, 'shape': (2, {side}, {side}), }}".ljust(117) + "\n"
        path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + bytes(100))
    else:
        tifffile.imwrite(path, NARROW, photometric="minisblack", metadata=None)
        data = path.read_bytes()
        path.write_bytes(data.replace(struct.pack("<HHII", 256, 4, 1, 70), struct.pack("<HHII", 256, 4, 1, side)))


@pytest.mark.parametrize("name", ["s.png", "s.npy", "s.tif"])
def test_a_header_that_claims_too_much_is_refused_before_memory_is_asked_for(tmp_path, name):
    claim(tmp_path / name, 10_000_000)
    with pytest.raises(ValueError, match=r"claims 10000000 x|exceeds limit of") as caught:
        open_frames(tmp_path / name)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("name", [name for name in KINDS if name.endswith((".tif", ".png", ".gif", ".webp"))])
def test_no_damage_of_a_file_is_a_surprise(tmp_path, name):
    """Whatever byte is wrong: frames, frames with a reason, or a ValueError in one line."""
    rng, path = np.random.default_rng(len(name)), tmp_path / name
    KINDS[name].write(path)
    data, said = np.frombuffer(path.read_bytes(), np.uint8), []
    for _ in range(12):
        spoilt = data.copy()
        spoilt[rng.integers(min(len(data), 400), size=3)] = rng.integers(256, size=3)
        path.write_bytes(spoilt[: rng.integers(len(data) // 2, len(data) + 1)].tobytes())
        try:
            for frame in islice(open_frames(path, **KINDS[name].choice), 20):
                assert (frame.pixels is None) == (frame.damage is not None)
        except ValueError as error:
            said.append(str(error))
    assert all(len(each.splitlines()) == 1 for each in said)


def write_jpegs(path: Path, packets: list[bytes]) -> None:
    """Motion JPEG of packets of 64 x 48 px as they are."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for number, data in enumerate(packets):
            packet = av.Packet(data)
            packet.pts = packet.dts = number
            packet.time_base, packet.stream = Fraction(1, 20), stream
            container.mux(packet)


def test_motion_jpeg_is_read_as_its_pictures_would_be(tmp_path):
    """As JPEG files in a folder are, whatever colours they have; what libjpeg finds fault with is left to FFmpeg."""
    rng = np.random.default_rng(0)
    colours = cv2.resize(rng.integers(0, 256, (4, 6, 8, 3), np.uint8)[0], (64, 48), interpolation=cv2.INTER_CUBIC)
    coded = [cv2.imencode(".jpg", np.roll(colours, k, 1))[1].tobytes() for k in range(4)]
    write_jpegs(tmp_path / "v.mkv", [coded[0], coded[1], coded[2][:-2], coded[3][: len(coded[3]) // 2]])
    first, second, endless, damaged = open_frames(tmp_path / "v.mkv")
    for frame, data in ((first, coded[0]), (second, coded[1])):
        as_file = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(frame.pixels.numpy(), as_file)
        shown = frame.picture().permute(1, 2, 0).numpy().astype(int)
        assert np.abs(shown - cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]).mean() < 2
    wanted = cv2.imdecode(np.frombuffer(coded[2], np.uint8), cv2.IMREAD_GRAYSCALE).astype(int)
    assert np.abs(endless.pixels.numpy() - wanted).max() <= 1
    assert "cannot be decoded" in damaged.damage


def test_motion_jpeg_that_was_grey_is_in_colour_soon_after_it_shows_some(tmp_path):
    """And for good; its grey levels are there at once, and a picture that is asked for alone is what it is."""
    rng = np.random.default_rng(0)
    colours = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)
    grey, coloured = (cv2.imencode(".jpg", each)[1].tobytes() for each in (np.zeros_like(colours) + 90, colours))
    write_jpegs(tmp_path / "v.mkv", [grey] * 5 + [coloured] * 30 + [grey])
    source = open_frames(tmp_path / "v.mkv")
    frames = list(source)
    shown = [frame.picture().dim() == 3 for frame in frames]
    assert shown == sorted(shown)
    assert shown[30] > shown[4]
    assert source[6].picture().dim() == 3
    assert all(frame.pixels.float().std() > 5 for frame in frames[5:35])


def test_a_jpeg_in_a_video_that_claims_another_size_is_damaged(tmp_path):
    """Before its memory is asked for."""
    data = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
    at = data.index(b"\xff\xc0") + 5
    claims = data[:at] + b"\xff\xdc\xff\xdc" + data[at + 4 :]
    write_jpegs(tmp_path / "v.mkv", [data, claims])
    first, second = open_frames(tmp_path / "v.mkv")
    assert first.damage is None
    assert second.damage


def test_motion_jpeg_that_ends_after_its_header_is_refused(tmp_path):
    """Whatever a camera's program had written when it died."""
    data = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
    write_jpegs(tmp_path / "v.avi", [data] * 3)
    whole = (tmp_path / "v.avi").read_bytes()
    (tmp_path / "v.avi").write_bytes(whole[: whole.index(b"movi") + 4])
    with pytest.raises(ValueError, match=r"v\.avi holds no frame that can be read"):
        list(open_frames(tmp_path / "v.avi"))


def test_motion_jpeg_without_a_luma_plane_is_left_to_ffmpeg(tmp_path):
    colours = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    Image.fromarray(colours).save(tmp_path / "f.jpg", keep_rgb=True)
    write_jpegs(tmp_path / "v.mkv", [(tmp_path / "f.jpg").read_bytes()])
    with av.open(str(tmp_path / "v.mkv")) as container:
        made = next(container.decode(video=0)).to_ndarray(format="rgb24")
    frame = open_frames(tmp_path / "v.mkv")[0]
    np.testing.assert_array_equal(frame.pixels.numpy(), cv2.cvtColor(made, cv2.COLOR_RGB2GRAY))
