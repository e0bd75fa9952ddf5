"""What a container says of its pictures, and a path of a container: neither is to be taken for another thing."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from PIL import Image
from test_io_kinds import NARROW, WIDE, picture

from torch_ecc.cli import app
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Session
from torch_ecc.io import open_frames
from torch_ecc.io.frames import nominal_rate


def film(path: Path, codec: str, pixel: str, frames: np.ndarray = NARROW, begins_ms: int = 0, **options: str) -> Path:
    """25 frames per second."""
    with av.open(str(path.absolute()), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], pixel
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for number, frame in enumerate(frames):
            image = picture(frame, pixel)
            image.pts, image.time_base = begins_ms + 40 * number, Fraction(1, 1000)
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return path


def levels(path: str | Path, **choice: int) -> list[np.ndarray]:
    return [frame.pixels.numpy() for frame in open_frames(path, **choice)]


@pytest.mark.parametrize("name", ["v.mkv", "v.webm", "v.nut", "v.mov"])
def test_a_film_that_does_not_begin_at_zero_is_whole(tmp_path, name):
    """Cameras count from when they were switched on, and some containers say when they end, not how long they are."""
    codec = {"v.webm": "libvpx-vp9"}.get(name, "mpeg4")
    source = open_frames(film(tmp_path / name, codec, "yuv420p", begins_ms=10_000))
    assert source.length == pytest.approx(6, abs=1)
    assert [frame.time_s for frame in source] == pytest.approx([10 + 0.04 * k for k in range(6)], abs=1e-3)


TURNS = {
    "as it is": ((1, 0), (0, 1)),
    "left": ((0, -1), (1, 0)),
    "over": ((-1, 0), (0, -1)),
    "right": ((0, 1), (-1, 0)),
    "a mirror": ((-1, 0), (0, 1)),
    "upside down in a mirror": ((1, 0), (0, -1)),
    "rows for columns": ((0, 1), (1, 0)),
    "columns for rows, in a mirror": ((0, -1), (-1, 0)),
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_film_is_seen_as_it_is_shown(tmp_path, turn):
    """A telephone's films are turned, and those of its front mirrored, by a matrix: x' = a x + c y, y' = b x + d y."""
    (a, b), (c, d) = TURNS[turn]
    path = film(tmp_path / "v.mp4", "libx264", "yuv420p", crf="1")
    data = bytearray(path.read_bytes())
    one = 1 << 16
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    h, w = NARROW.shape[1:]
    y, x = np.mgrid[:h, :w]
    to_x, to_y = a * x + c * y, b * x + d * y
    to_x, to_y = to_x - to_x.min(), to_y - to_y.min()
    for frame, stored in zip(open_frames(path), NARROW, strict=True):
        shown = np.empty((to_y.max() + 1, to_x.max() + 1), np.uint8)
        shown[to_y, to_x] = stored
        assert frame.pixels.shape == shown.shape
        assert np.abs(shown.astype(int) - frame.pixels.numpy()).max() <= 4
        assert frame.picture().shape[-2:] == shown.shape


@pytest.mark.parametrize("name", ["run:1.mkv", "concat:v.mkv", "data:v.mkv", " v.mkv", "v .mkv", "%d [b]v.mkv"])
def test_a_name_is_a_name(tmp_path, name, monkeypatch):
    """FFmpeg would take what stands before a colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    film(Path(name), "ffv1", "gray")
    np.testing.assert_array_equal(levels(name), NARROW)


def test_a_name_with_spaces_around_it_that_is_not_there_is_tried_without(tmp_path):
    film(tmp_path / "v.mkv", "ffv1", "gray")
    np.testing.assert_array_equal(levels(f" {tmp_path / 'v.mkv'} "), NARROW)


def test_results_lie_in_a_folder_of_any_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("v.npy", NARROW)
    Session(TrackJob(input="v.npy", centers=((35.0, 24.0),), size=(31, 31), out="run:1")).run()
    assert len(list(open_frames("run:1/overlay.mp4"))) == 6


@pytest.mark.parametrize("name", ["a$_{$b.mkv", "a\nb.mkv", "\x1b[31mred.mkv", "[bold]a.mkv"])
def test_a_name_is_no_code(tmp_path, name):
    """Neither of mathematics in a picture nor of colours on a screen."""
    film(tmp_path / name, "ffv1", "gray")
    out = tmp_path / "r[bold]"
    command = ["track", str(tmp_path / name), "--center", "35", "24", "--size", "31", "--out", str(out)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert (out / "track.png").is_file()
    assert f"In {out}/: overlay.mp4, " in done.output
    shown = {"a\nb.mkv": "a\\nb.mkv", "\x1b[31mred.mkv": "\\x1b[31mred.mkv"}.get(name, name)
    assert f"{shown} " in done.output
    assert open_frames(tmp_path / name).name == shown


def test_pages_under_the_name_of_a_film_are_refused(tmp_path):
    """FFmpeg reads the first page only."""
    with open(tmp_path / "v.mp4", "wb") as file:
        tifffile.imwrite(file, WIDE, photometric="minisblack")
    with pytest.raises(ValueError, match=r"v.mp4 is an image \(tiff\), give it such a name"):
        open_frames(tmp_path / "v.mp4")


def test_the_picture_of_a_sound_is_no_film(tmp_path):
    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        sound, sleeve = container.add_stream("aac", rate=8000), container.add_stream("png", rate=1)
        sleeve.width, sleeve.height, sleeve.pix_fmt = 70, 48, "gray"
        sleeve.disposition = 1024
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), format="fltp", layout="mono")
        silence.sample_rate, silence.pts, silence.time_base = 8000, 0, Fraction(1, 8000)
        container.mux(sound.encode(silence))
        container.mux(sound.encode())
        container.mux(sleeve.encode(av.VideoFrame.from_ndarray(NARROW[0], format="gray")))
        container.mux(sleeve.encode())
    with pytest.raises(ValueError, match="holds no video that can be decoded"):
        open_frames(tmp_path / "v.mp4")


def test_which_of_several_films_is_read_is_said(tmp_path):
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 70, 48, "gray"
        for frame in NARROW:
            for stream, shown in zip(streams, (frame, 255 - frame), strict=True):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="gray")))
        for stream in streams:
            container.mux(stream.encode())
    source = open_frames(tmp_path / "v.mkv")
    assert source.notes == ("v.mkv: of its 2 videos the one of 70 x 48 px is read",)
    np.testing.assert_array_equal(levels(tmp_path / "v.mkv"), NARROW)


def test_a_bayer_pattern_keeps_its_depth(tmp_path):
    with av.open(str(tmp_path / "v.nut"), "w") as container:
        stream = container.add_stream("rawvideo", rate=25)
        stream.width, stream.height, stream.pix_fmt = 70, 48, "bayer_rggb16le"
        for frame in np.full((3, 48, 70), 12345, np.uint16):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bayer_rggb16le")))
        container.mux(stream.encode())
    for found in levels(tmp_path / "v.nut"):
        assert found.dtype == np.uint16
        np.testing.assert_allclose(found[2:-2, 2:-2], 12345, atol=2)


def test_times_that_do_not_go_on_are_told(tmp_path):
    """Two times are changed in the blocks of a Matroska file."""
    path = film(tmp_path / "v.mkv", "ffv1", "gray")
    data = path.read_bytes()
    for before, after in ((80, 40), (160, 60)):
        old, new = (b"\x81" + struct.pack(">H", ms) for ms in (before, after))
        assert data.count(old) == 1
        data = data.replace(old, new)
    path.write_bytes(data)
    job = TrackJob(input=str(path), centers=((35.0, 24.0),), size=(31, 31), out=str(tmp_path / "r"), overlay=False)
    said = Session(job).run().words()
    assert "The time of 2 frames is not later than that of the frame before: --fps tells it" in said
    assert [row.time_s for row in open_frames(path)] == pytest.approx([0, 0.04, 0.04, 0.12, 0.06, 0.2])


def test_the_first_file_that_is_damaged_is_named(tmp_path):
    for number, frame in enumerate(NARROW):
        Image.fromarray(frame).save(tmp_path / f"f{number}.png")
    (tmp_path / "f2.png").write_bytes(b"")
    (tmp_path / "f4.png").write_bytes(b"")
    job = TrackJob(input=str(tmp_path), centers=((35.0, 24.0),), size=(31, 31), out=str(tmp_path / "r"), overlay=False)
    said = Session(job).run().words()
    example = "frame 2 (f2.png cannot be read (it is empty))"
    assert f"2 of 6 frames are damaged, as {example}: track.csv says which and why" in said


def test_the_rate_of_one_channel_is_its_own(tmp_path):
    planes = {"DeltaT": [0.1 * k + 0.01 * c for k in range(6) for c in range(2)]}
    both = np.stack([WIDE, WIDE], 1)
    told = {"axes": "TCYX", "Plane": planes}
    tifffile.imwrite(tmp_path / "s.ome.tif", both, photometric="minisblack", metadata=told)
    assert open_frames(tmp_path / "s.ome.tif", channel=1).fps == pytest.approx(10)


def test_a_palette_beside_an_opacity_shows_its_colours(tmp_path):
    image = Image.fromarray(NARROW[0])
    image.putpalette(np.random.default_rng(0).integers(0, 256, 768, dtype=np.uint8).tobytes())
    image.save(tmp_path / "one.tif")
    image.convert("PA").save(tmp_path / "two.tif")
    assert tifffile.TiffFile(tmp_path / "two.tif").pages.first.samplesperpixel == 2
    np.testing.assert_array_equal(levels(tmp_path / "one.tif"), levels(tmp_path / "two.tif"))


def test_a_rate_is_that_of_most_frames(tmp_path):
    assert nominal_rate([0.0, 0.1, 0.2, 5.2, 5.3]) == pytest.approx(10)
    assert nominal_rate([0.0, 0.1, 0.2, 2.5e7]) == pytest.approx(10)
    assert nominal_rate([1.0]) is None
