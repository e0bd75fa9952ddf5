"""Reading: every medium gives back the pixels that went in, one frame at a time, and says in words what is wrong."""

from __future__ import annotations

import re
import struct
import threading
import tracemalloc
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from torch_ecc.io import Frame, FrameError, FrameSource, live, open_frames
from torch_ecc.io.beside import ahead

DTYPES = [np.uint8, np.uint16, np.float32]
F, H, W = 12, 10, 14


def stack(dtype, *, channels: int = 0, count: int = F) -> np.ndarray:
    rng = np.random.default_rng(7)
    shape = (count, H, W, channels) if channels else (count, H, W)
    if np.dtype(dtype).kind == "f":
        return rng.normal(size=shape).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def expected(frame: np.ndarray) -> np.ndarray:
    return frame if frame.ndim == 2 else np.moveaxis(frame[..., :3], -1, 0)


def gray(frame: np.ndarray) -> np.ndarray:
    """By ITU-R 601, in float64."""
    return frame if frame.ndim == 2 else frame[..., :3].astype(np.float64) @ (0.299, 0.587, 0.114)


def assert_same(source: FrameSource, frames: np.ndarray) -> None:
    """Bit by bit, in order, of the same dtype, twice."""
    assert source.shape == (H, W)
    for _ in range(2):
        found = list(source)
        assert [frame.number for frame in found] == list(range(len(frames)))
        for frame, wanted in zip(found, frames, strict=True):
            assert frame.pixels.is_contiguous()
            assert frame.pixels.dtype == source.dtype == torch.from_numpy(wanted).dtype
            np.testing.assert_array_equal(frame.picture().numpy(), expected(wanted))
            rounded = 0 if wanted.ndim == 2 else {"uint8": 0.51, "uint16": 2}.get(str(wanted.dtype), 1e-6)
            np.testing.assert_allclose(frame.pixels.numpy(), gray(wanted), atol=rounded, rtol=0)


def stacked(source: FrameSource) -> np.ndarray:
    return np.stack([frame.pixels.numpy() for frame in source])


def damages(source: FrameSource) -> list[str]:
    """What is said of the frames that are damaged."""
    for frame in source:
        assert (frame.pixels is None) == (frame.damage is not None)
    return [f"frame {frame.number}: {frame.damage}" for frame in source if frame.damage]


def save_pillow_tiff(path: Path, frames: np.ndarray, **options) -> None:
    pages = [Image.fromarray(frame) for frame in frames]
    pages[0].save(path, save_all=True, append_images=pages[1:], **options)


# ---- what goes in comes out ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [0, 1, 3, 4])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("save", [np.save, np.savez, np.savez_compressed], ids=["npy", "npz", "npz compressed"])
def test_array_stacks(tmp_path, save, dtype, channels):
    frames = stack(dtype, channels=channels)
    path = tmp_path / ("s.npy" if save is np.save else "s.npz")
    save(path, frames)
    source = open_frames(path)
    assert len(source) == source.length == F
    assert source.fps is None
    assert_same(source, frames[..., 0] if channels == 1 else frames)


def test_stack_with_channels_first(tmp_path):
    frames = stack(np.uint8, channels=3)
    np.save(tmp_path / "s.npy", np.moveaxis(frames, -1, 1).copy())
    assert_same(open_frames(tmp_path / "s.npy"), frames)


def test_npz_takes_the_array_named_frames(tmp_path):
    frames = stack(np.uint8)
    np.savez(tmp_path / "s.npz", times=np.arange(F), frames=frames)
    assert_same(open_frames(tmp_path / "s.npz"), frames)


@pytest.mark.parametrize("dtype", [">u2", "<u2", ">f4", ">f8", "f8", "f2", "i1", "i2", "i4", "i8", "u4", "?"])
def test_other_dtypes_keep_their_values(tmp_path, dtype):
    frames = np.random.default_rng(3).integers(0, 2 if dtype == "?" else 100, (3, H, W)).astype(dtype)
    np.save(tmp_path / "s.npy", frames)
    source = open_frames(tmp_path / "s.npy")
    assert source.dtype == {">u2": torch.uint16, "<u2": torch.uint16, "?": torch.uint8}.get(dtype, torch.float32)
    scale = 255 if dtype == "?" else 1
    np.testing.assert_array_equal(stacked(source), frames.astype(np.float64) * scale)


@pytest.mark.parametrize(
    ("dtype", "value", "reason"),
    [
        (np.int64, 2**24 + 1, "it holds int64 values beyond 2^24, which float32 does not hold: scale them to uint16"),
        (np.float32, np.nan, "it holds NaN or infinite values"),
        (np.float64, 1e300, "it holds NaN or infinite values"),
    ],
)
def test_numbers_that_cannot_be_used_damage_their_frame_only(tmp_path, dtype, value, reason):
    frames = np.zeros((3, H, W), dtype)
    frames[1, 0, 0] = value
    np.save(tmp_path / "s.npy", frames)
    source = open_frames(tmp_path / "s.npy")
    assert damages(source) == [f"frame 1: {reason}"]
    assert source[2].damage is None


@pytest.mark.parametrize("as_stack", [np.asarray, torch.from_numpy, list], ids=["numpy", "torch", "lazy"])
def test_anything_indexed_like_an_array(as_stack):
    class Lazy:
        """An array of which only one frame at a time is ever computed."""

        def __init__(self, frames: list) -> None:
            self.frames, self.shape = frames, (len(frames), *frames[0].shape)

        def __getitem__(self, index: int) -> np.ndarray:
            return self.frames[index]

    frames = stack(np.uint16)
    array = Lazy(list(frames)) if as_stack is list else as_stack(frames)
    source = open_frames(array, fps=4.0)
    assert_same(source, frames)
    assert [frame.time_s for frame in source] == [k / 4 for k in range(F)]


@pytest.mark.parametrize("kind", ["npy", "npz", "tif", "folder", "mkv"])
def test_frames_are_had_by_their_numbers(tmp_path, kind):
    frames = stack(np.uint8)
    path = tmp_path / f"s.{kind}"
    if kind == "folder":
        path.mkdir()
        for k, frame in enumerate(frames):
            cv2.imwrite(str(path / f"{k}.png"), frame)
    elif kind == "mkv":
        write_video(path, "FFV1", frames)
    elif kind == "tif":
        save_pillow_tiff(path, frames)
    else:
        (np.save if kind == "npy" else np.savez)(path, frames)
    source = open_frames(path)
    some = source[2:9:3]
    assert [frame.number for frame in some] == [2, 5, 8]
    np.testing.assert_array_equal(stacked(some), frames[2:9:3])
    assert [frame.time_s for frame in some] == [source[k].time_s for k in (2, 5, 8)]
    assert len(some) == 3
    np.testing.assert_array_equal(source[7].pixels.numpy(), frames[7])
    with pytest.raises(IndexError, match=f"has no frame {F}"):
        source[F]
    with pytest.raises(ValueError, match="expected a step of 1 or more, got -1"):
        source[::-1]


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate", "packbits"])
@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 0), (np.uint16, 0), (np.float32, 0), (np.uint8, 3)])
def test_tiff_pages(tmp_path, dtype, channels, compression):
    frames = stack(dtype, channels=channels)
    save_pillow_tiff(tmp_path / "s.tif", frames, compression=compression)
    source = open_frames(tmp_path / "s.tif")
    assert len(source) == F
    assert_same(source, frames)


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 3), (np.uint16, 3), (np.uint16, 4), (np.float32, 3)])
def test_colour_tiff_pages_keep_their_depth(tmp_path, dtype, channels):
    """Pillow would read 16-bit colours as 8-bit ones, and no float colours at all."""
    frames = stack(dtype, channels=channels)
    bgr = [cv2.cvtColor(f, cv2.COLOR_RGB2BGR if channels == 3 else cv2.COLOR_RGBA2BGRA) for f in frames]
    raw = [cv2.IMWRITE_TIFF_COMPRESSION, 1]  # older OpenCV would round float colours to LogLuv
    assert cv2.imwritemulti(str(tmp_path / "s.tiff"), bgr, raw)
    assert_same(open_frames(tmp_path / "s.tiff"), frames)


def test_float64_tiff(tmp_path):
    frames = stack(np.float64, count=3)
    assert cv2.imwritemulti(str(tmp_path / "s.tif"), list(frames))
    assert_same(open_frames(tmp_path / "s.tif"), frames.astype(np.float32))


def big_endian_tiff(image: np.ndarray) -> bytes:
    """A TIFF of one strip as instruments write it; TIFF writers at hand only write little-endian files."""
    data = image.tobytes()
    bits, kind = 8 * image.itemsize, {"u": 1, "i": 2, "f": 3}[image.dtype.kind]
    tags = [(256, W), (257, H), (258, bits), (259, 1), (262, 1), (273, 8), (277, 1), (278, H), (279, len(data))]
    entries = b"".join(struct.pack(">HHII", tag, 4, 1, value) for tag, value in [*tags, (339, kind)])
    count = struct.pack(">H", len(tags) + 1)
    return b"MM\0*" + struct.pack(">I", 8 + len(data)) + data + count + entries + bytes(4)


@pytest.mark.parametrize("dtype", [">u2", ">i2", ">f4"])
def test_big_endian_tiff(tmp_path, dtype):
    frame = stack(np.uint16)[0].astype(dtype)
    (tmp_path / "s.tif").write_bytes(big_endian_tiff(frame))
    found = open_frames(tmp_path / "s.tif").first
    np.testing.assert_array_equal(found.numpy(), frame)
    assert found.dtype == (torch.uint16 if dtype == ">u2" else torch.float32)


def test_black_and_white_tiff(tmp_path):
    frames = stack(np.uint8) > 100
    save_pillow_tiff(tmp_path / "s.tif", frames)
    assert_same(open_frames(tmp_path / "s.tif"), frames * np.uint8(255))


def test_palette_tiff_shows_its_colours(tmp_path):
    image = Image.fromarray(stack(np.uint8, channels=3)[0]).quantize(8)
    image.save(tmp_path / "s.tif")
    (found,) = open_frames(tmp_path / "s.tif")
    np.testing.assert_array_equal(found.picture().numpy(), expected(np.asarray(image.convert("RGB"))))


@pytest.mark.parametrize(
    ("suffix", "dtype", "channels"),
    [
        (".png", np.uint8, 0),
        (".png", np.uint16, 0),
        (".png", np.uint8, 3),
        (".png", np.uint16, 3),
        (".png", np.uint8, 4),
        (".bmp", np.uint8, 0),
        (".pgm", np.uint16, 0),
        (".tif", np.float32, 0),
        (".tif", np.uint16, 3),
    ],
)
def test_image_folders_and_globs(tmp_path, suffix, dtype, channels):
    """In natural order: 2 comes before 10. What is not an image is passed over."""
    frames = stack(dtype, channels=channels)
    codes = {0: None, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    for index, frame in enumerate(frames):
        picture = frame if codes[channels] is None else cv2.cvtColor(frame, codes[channels])
        raw = [cv2.IMWRITE_TIFF_COMPRESSION, 1]
        assert cv2.imwrite(str(tmp_path / f"f{index}{suffix.upper() if index % 2 else suffix}"), picture, raw)
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / f"._f0{suffix}").write_text("not an image either")
    assert_same(open_frames(tmp_path), frames)
    assert_same(open_frames(str(tmp_path / "f*")), frames)
    assert len(open_frames(tmp_path)) == F


def test_one_image_is_a_sequence_of_one(tmp_path):
    frames = stack(np.uint8, count=1)
    cv2.imwrite(str(tmp_path / "f[1].png"), frames[0])
    assert_same(open_frames(tmp_path / "f[1].png"), frames)  # a name with wildcards in it is a name first
    assert_same(open_frames(str(tmp_path / "*.png")), frames)


def ramps(count: int = 30) -> np.ndarray:
    x = np.arange(64, dtype=np.float32)
    ramp = np.add.outer(x[:48], x)
    return np.stack([ramp + 2 * k for k in range(count)]).astype(np.uint8)


def write_video(path: Path, codec: str, frames: np.ndarray) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 20.0, frames.shape[2:0:-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


@pytest.mark.parametrize(("name", "codec", "loss"), [("v.mp4", "mp4v", 12), ("v.avi", "MJPG", 6), ("v.mkv", "FFV1", 0)])
def test_video(tmp_path, name, codec, loss):
    frames = ramps()
    write_video(tmp_path / name, codec, frames)
    source = open_frames(str(tmp_path / name))
    assert (len(source), source.fps, source.shape, source.name) == (30, 20.0, (48, 64), name)
    for _ in range(2):
        found = stacked(source)
        assert found.dtype == np.uint8
        assert found.shape == (30, 48, 64)
        colours = np.stack([frame.picture().reshape(-1, 48, 64).numpy() for frame in source])
        assert np.abs(colours.astype(int) - frames[:, None]).max() <= loss
        assert [frame.time_s for frame in source] == pytest.approx([k / 20 for k in range(30)], abs=1e-9)


@pytest.mark.parametrize(("codec", "pixel"), [("mjpeg", "yuvj420p"), ("libx264", "yuv420p"), ("libx264", "yuv444p")])
def test_a_grey_video_shows_the_grey_that_its_colours_would_be(tmp_path, codec, pixel):
    """No colours are made for it, and its darkest and brightest stay black and white."""
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=20, options={"crf": "1"} if codec == "libx264" else {})
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixel
        for picture in ramps(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray")))
        container.mux(stream.encode())
    with av.open(str(path)) as container:
        made = [frame.to_ndarray(format="gray").astype(int) for frame in container.decode(video=0)]
    for frame, wanted in zip(open_frames(path), made, strict=True):
        assert frame.picture().shape == (48, 64)
        assert np.abs(frame.picture().numpy() - wanted).max() <= 2


def test_video_is_rgb(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "v.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (64, 48))
    for _ in range(5):
        writer.write(np.full((48, 64, 3), (10, 20, 230), np.uint8))  # blue, green, red
    writer.release()
    red, _, blue = open_frames(tmp_path / "v.mp4")[0].picture()
    assert red.float().mean() > 200
    assert blue.float().mean() < 40


class FakeCamera:
    """A camera that counts upwards and breaks at its fifth frame; each has to be let go."""

    opened = 0
    ready = threading.Semaphore(0)

    def __init__(self, index: int) -> None:
        self.index, self.count = index, 0
        type(self).opened += 1

    def isOpened(self) -> bool:
        return self.index == 3

    def get(self, _: int) -> float:
        return 30.0

    def release(self) -> None:
        pass

    def read(self) -> tuple[bool, np.ndarray]:
        self.ready.acquire()
        self.count += 1
        return self.count < 5, np.full((4, 6, 3), self.count, np.uint8)


@pytest.mark.parametrize("source", [3, "3", " 03 "])
def test_camera(monkeypatch, source):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    monkeypatch.setattr(FakeCamera, "opened", 0)
    monkeypatch.setattr(FakeCamera, "ready", threading.Semaphore(1))
    live.close_cameras()
    camera = open_frames(source)
    assert (camera.length, camera.fps, camera.shape) == (None, 30.0, (4, 6))
    with pytest.raises(TypeError, match="number of frames of opencv 3 is not known"):
        len(camera)
    stream, frames = iter(camera), []
    for _ in range(3):
        FakeCamera.ready.release()
        frames.append(next(stream))
    assert [(frame.number, int(frame.pixels[0, 0])) for frame in frames] == [(0, 2), (1, 3), (2, 4)]
    assert all(a.time_s < b.time_s for a, b in pairwise(frames))
    assert [frame.arrival.lost for frame in frames] == [0, 0, 0]
    FakeCamera.ready.release()
    with pytest.raises(FrameError, match="frame 3: camera 3 delivers no frame any more"):
        next(stream)
    assert FakeCamera.opened == 1  # opening one takes a second and resets its exposure


# ---- memory --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["npy", "npz", "tif"])
def test_memory_does_not_grow_with_the_length(tmp_path, kind):
    frames = np.ones((100, 200, 300), np.float32)
    path = tmp_path / f"s.{kind}"
    if kind == "tif":
        save_pillow_tiff(path, frames)
    else:
        (np.save if kind == "npy" else np.savez_compressed)(path, frames)
    tracemalloc.start()
    try:
        total = sum(float(frame.pixels[0, 1]) for frame in open_frames(path))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert total == 100
    assert peak < 8 * frames[0].nbytes  # the whole stack is 100 frames


def test_frames_own_their_memory(tmp_path):
    frames = stack(np.uint8)
    np.save(tmp_path / "s.npy", frames)
    for frame in open_frames(tmp_path / "s.npy"):
        frame.pixels.zero_()
    assert_same(open_frames(tmp_path / "s.npy"), frames)


# ---- damage in the middle ------------------------------------------------------------------------------------------


def cut(path: Path, fraction: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    return path


def read_until_end(path: Path) -> tuple[list[Frame], FrameError]:
    found = []

    def read_all() -> None:
        for frame in open_frames(path):
            found.append(frame)  # noqa: PERF402, those before the error are wanted

    with pytest.raises(FrameError) as caught:
        read_all()
    return found, caught.value


@pytest.mark.parametrize("fraction", [0.35, 0.6, 0.9])
@pytest.mark.parametrize("kind", ["npy", "tif"])
def test_what_comes_before_the_cut_is_kept(tmp_path, kind, fraction):
    frames = stack(np.uint16)
    path = tmp_path / f"s.{kind}"
    if kind == "tif":
        save_pillow_tiff(path, frames)
    else:
        np.save(path, frames)
    found, error = read_until_end(cut(path, fraction))
    good = [frame.pixels.numpy() for frame in found if frame.damage is None]
    assert 0 < len(good) <= len(found) <= len(good) + 1
    assert error.frame == len(found) < F
    assert str(error).startswith(f"frame {error.frame}: ")
    np.testing.assert_array_equal(good, frames[: len(good)])


def test_damaged_archive(tmp_path):
    frames = np.random.default_rng(0).integers(0, 255, (40, 64, 64), dtype=np.uint8)
    path = tmp_path / "s.npz"
    np.savez_compressed(path, frames=frames)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    path.write_bytes(data)
    found, error = read_until_end(path)
    assert "the file is damaged" in str(error)
    assert 5 < len(found) < 40
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in found[:5]], frames[:5])


@pytest.mark.parametrize(("name", "codec"), [("v.avi", "MJPG"), ("v.mkv", "FFV1")])
def test_cut_video(tmp_path, name, codec):
    write_video(tmp_path / name, codec, ramps())
    found, error = read_until_end(cut(tmp_path / name, 0.6))
    assert 5 < len(found) < 28
    assert f"{name} ends here, but declares 30 frames" in str(error)


def damage_packet(source: Path, target: Path, which: int) -> None:
    """The same video with half of one packet."""
    with av.open(str(source)) as whole, av.open(str(target), "w") as damaged:
        (stream,) = whole.streams.video
        copy = damaged.add_stream_from_template(stream)
        for number, packet in enumerate(packet for packet in whole.demux(stream) if packet.dts is not None):
            half = av.Packet(bytes(packet)[: packet.size // (2 if number == which else 1)])
            half.pts, half.dts, half.time_base, half.stream = packet.pts, packet.dts, packet.time_base, copy
            half.is_keyframe = packet.is_keyframe
            damaged.mux(half)


@pytest.mark.parametrize(
    ("name", "codec", "pixel", "last"),
    [
        ("v.mkv", "mjpeg", "yuvj420p", 12),
        ("v.nut", "png", "gray", 12),
        ("v.avi", "mpeg4", "yuv420p", 23),  # a group of twelve frames, each predicted from the last
        ("v.webm", "libvpx-vp9", "yuv420p", 19),
    ],
)
def test_a_damaged_frame_of_a_video_is_told_and_passed_over(tmp_path, name, codec, pixel, last):
    whole, damaged = tmp_path / f"whole{name}", tmp_path / f"damaged{name}"
    with av.open(str(whole), "w") as container:
        stream = container.add_stream(codec, rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixel
        stream.codec_context.gop_size = {"libvpx-vp9": 20}.get(codec, 12)
        for frame in ramps():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray").reformat(format=pixel)))
        container.mux(stream.encode())
    damage_packet(whole, damaged, 12)
    clean, source = stacked(open_frames(whole)), open_frames(damaged)
    assert damages(source)[0].startswith("frame 12: it cannot be decoded")
    assert [frame.number for frame in source if frame.damage] == list(range(12, last + 1))
    assert [frame.time_s for frame in source] == pytest.approx([k / 20 for k in range(30)], abs=1e-3)
    for frame in source:
        assert frame.damage or np.array_equal(frame.pixels.numpy(), clean[frame.number])


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (None, r"frame 2: f2.png cannot be read \(Truncated File Read\)"),
        (b"", r"frame 2: f2.png cannot be read \(it is empty\)"),
        (np.zeros((H, W + 1), np.uint8), rf"frame 2: f2.png is {W + 1} x {H} px, but f0.png is {W} x {H} px"),
        (np.zeros((H, W), np.uint16), "frame 2: f2.png is uint16, but f0.png is uint8"),
    ],
    ids=["damaged", "empty", "size", "depth"],
)
def test_a_folder_with_one_bad_image(tmp_path, picture, reason):
    for index, frame in enumerate(stack(np.uint8, count=4)):
        cv2.imwrite(str(tmp_path / f"f{index}.png"), frame)
    if picture is None:
        cut(tmp_path / "f2.png", 0.5)
    elif isinstance(picture, bytes):
        (tmp_path / "f2.png").write_bytes(picture)
    else:
        cv2.imwrite(str(tmp_path / "f2.png"), picture)
    (found,) = damages(open_frames(tmp_path))
    assert re.match(reason, found)


# ---- refused at the door -------------------------------------------------------------------------------------------


def make_bad_files(folder: Path) -> None:
    frames = stack(np.uint8)
    (folder / "empty").mkdir()
    (folder / "texts").mkdir()
    (folder / "texts" / "a.txt").write_text("a")
    (folder / "mixed").mkdir()
    for name in ("a.png", "a.jpg"):
        cv2.imwrite(str(folder / "mixed" / name), frames[0])
    (folder / "stacks").mkdir()
    for name in ("a.tif", "b.tif"):
        save_pillow_tiff(folder / "stacks" / name, frames)
    for name in ("notes.txt", "bad.mp4", "bad.tif", "bad.npy", "bad.npz", "bad.png"):
        (folder / name).write_text("nothing of the kind")
    np.save(folder / "flat.npy", frames[0])
    np.save(folder / "odd.npy", np.zeros((2, 7, 8, 9)))
    np.save(folder / "none.npy", frames[:0])
    np.save(folder / "complex.npy", frames * 1j)
    np.save(folder / "words.npy", np.array([[["a"]]]))
    np.save(folder / "objects.npy", np.array([[[None]]]), allow_pickle=True)
    np.save(folder / "fortran.npy", np.asfortranarray(frames))
    np.savez(folder / "two.npz", left=frames, right=frames)
    np.savez(folder / "zero.npz")


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("nowhere.mp4", FileNotFoundError, "no such file, folder or camera: '.*nowhere.mp4'"),
        ("nowhere/*.png", FileNotFoundError, r"no file matches '.*nowhere/\*.png'"),
        ("empty", ValueError, "the folder .*empty is empty"),
        ("texts", ValueError, "no image in the folder .*texts .known: .bmp"),
        ("*.np[yz]", ValueError, r"no image in the \d+ files that match"),
        ("mixed", ValueError, r"several kinds of image in the folder .*mixed \(1 .jpg, 1 .png\); name one"),
        (
            "stacks",
            ValueError,
            "no frame that can be read .a.tif cannot be read .it has several pages; give a multi",
        ),
        ("notes.txt", ValueError, r"notes.txt has the extension '.txt', which is not known \(known: .*\.npz"),
        ("bad.mp4", ValueError, "bad.mp4 cannot be opened as a video"),
        ("bad.tif", ValueError, "bad.tif cannot be read as TIFF"),
        ("bad.npy", ValueError, "bad.npy cannot be read as a numpy array"),
        ("bad.npz", ValueError, "bad.npz cannot be read as .npz"),
        ("bad.png", ValueError, "bad.png cannot be read .it is damaged or not an image"),
        ("flat.npy", ValueError, r"flat.npy must be \(F, H, W\), .*, got \(10, 14\)"),
        ("odd.npy", ValueError, r"odd.npy must be .* got \(2, 7, 8, 9\)"),
        ("none.npy", ValueError, "none.npy holds no frame"),
        ("complex.npy", ValueError, "complex.npy must hold real numbers .* got dtype complex128"),
        ("words.npy", ValueError, "words.npy must hold real numbers .* got dtype <U1"),
        ("objects.npy", ValueError, "objects.npy must hold real numbers .* got dtype object"),
        ("fortran.npy", ValueError, "fortran.npy is in Fortran order: save numpy.ascontiguousarray"),
        ("two.npz", ValueError, r"two.npz must hold one array, or one named 'frames'; it holds \['left', 'right'\]"),
        ("zero.npz", ValueError, r"zero.npz must hold one array, or one named 'frames'; it holds \[\]"),
    ],
)
def test_bad_sources(tmp_path, source, error, message):
    make_bad_files(tmp_path)
    with pytest.raises(error, match=message):
        open_frames(tmp_path / source)


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        (-1, ValueError, "camera index must be 0 or more, got -1"),
        (4, ValueError, "camera 4 cannot be opened"),
        ("", FileNotFoundError, "no such file, folder or camera: ''"),
    ],
)
def test_bad_cameras(monkeypatch, source, error, message):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    with pytest.raises(error, match=message):
        open_frames(source)


def test_reading_ahead_is_given_up_without_waiting():
    """Whoever closes it may be the garbage collector, in a thread that holds locks."""
    begun, closed, ended = threading.Event(), threading.Event(), threading.Event()
    waited = []

    def slow():
        yield from range(4)
        begun.set()
        waited.append(closed.wait(60))
        ended.set()

    frames = ahead(slow())
    assert next(frames) == 0
    assert begun.wait(60)
    frames.close()
    closed.set()
    assert ended.wait(60)
    assert waited == [True]
