"""Formats that another library reads: what is made of what it gives, and what is said where it is not there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torch_ecc.io import extras, open_frames

FRAMES = np.random.default_rng(0).integers(0, 60000, (6, 2, 3, 10, 14), dtype=np.uint16)  # T, C, Z, Y, X


def stacked(path: Any, **choice: int) -> np.ndarray:
    return np.stack([frame.pixels.numpy() for frame in open_frames(path, **choice)])


@pytest.mark.parametrize("name", ["s.h5", "s.zarr"])
def test_a_stack_in_hdf5_or_zarr(tmp_path, name):
    library = pytest.importorskip({"s.h5": "h5py", "s.zarr": "zarr"}[name])
    if name == "s.zarr":
        library.save(str(tmp_path / name), FRAMES[:, 0, 0])
    else:
        with library.File(tmp_path / name, "w") as file:
            file["run/frames"], file["run/times"] = FRAMES[:, 0, 0], np.arange(6)
    source = open_frames(tmp_path / name, fps=10.0)
    np.testing.assert_array_equal(stacked(tmp_path / name), FRAMES[:, 0, 0])
    assert [frame.time_s for frame in source[2:4]] == [0.2, 0.3]


def test_two_stacks_in_hdf5_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["a"], file["b"] = FRAMES[:, 0, 0], FRAMES[:, 1, 0]
    with pytest.raises(ValueError, match=r"s.h5 must hold one stack, or one named 'frames'; it holds \['a', 'b'\]"):
        open_frames(tmp_path / "s.h5")


def test_ome_zarr_has_axes(tmp_path):
    zarr = pytest.importorskip("zarr")
    group = zarr.open_group(str(tmp_path / "s.zarr"), mode="w")
    group.create_array("0", data=FRAMES)
    axes = [{"name": name, "type": "time"} for name in "tczyx"]
    group.attrs["multiscales"] = [{"axes": axes, "datasets": [{"path": "0"}]}]
    with pytest.raises(ValueError, match="2 channels and 3 slices, which are not time"):
        open_frames(tmp_path / "s.zarr")
    np.testing.assert_array_equal(stacked(tmp_path / "s.zarr", channel=1, slice=2), FRAMES[:, 1, 2])
    source = open_frames(tmp_path / "s.zarr", channel=1, slice=2)
    assert (source.fps, source.um_per_px, source.timed) == (None, None, False)


@pytest.mark.parametrize("change", [{"type": "scale", "scale": [0.5]}, {"type": "scale", "scale": "abcde"}, {}, "text"])
def test_an_ome_zarr_scale_that_makes_no_sense_is_passed_over(tmp_path, change):
    zarr = pytest.importorskip("zarr")
    group = zarr.open_group(str(tmp_path / "s.zarr"), mode="w")
    group.create_array("0", data=FRAMES)
    axes = [{"name": name, "unit": "micrometer"} for name in "tczyx"]
    sets = [{"path": "0", "coordinateTransformations": [change]}]
    group.attrs["multiscales"] = [{"axes": axes, "datasets": sets}]
    source = open_frames(tmp_path / "s.zarr", channel=1, slice=2)
    assert (source.fps, source.um_per_px, source.timed) == (None, None, False)
    np.testing.assert_array_equal(stacked(tmp_path / "s.zarr", channel=1, slice=2), FRAMES[:, 1, 2])


def test_ome_zarr_tells_its_clock_and_scale(tmp_path):
    zarr = pytest.importorskip("zarr")
    group = zarr.open_group(str(tmp_path / "s.zarr"), mode="w")
    group.create_array("0", data=FRAMES)
    units = {"t": "millisecond", "z": "micrometer", "y": "nanometer", "x": "micrometer"}
    axes = [{"name": name} | ({"unit": units[name]} if name in units else {}) for name in "tczyx"]
    own = [{"type": "scale", "scale": [1, 1, 1, 300, 0.25]}]
    common = [{"type": "translation", "translation": [0, 0, 0, 5, 5]}, {"type": "scale", "scale": [40, 1, 1, 1, 1]}]
    images = [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": own}]}]
    group.attrs["multiscales"] = [images[0] | {"coordinateTransformations": common}]
    source = open_frames(tmp_path / "s.zarr", channel=0, slice=1)
    assert source.um_per_px == pytest.approx((0.25, 0.3))
    assert source.fps == pytest.approx(25)
    assert [frame.time_s for frame in source] == pytest.approx([0.04 * k for k in range(6)])


class ND2File:
    """As the library nd2 gives a file of six times and three slices of two channels."""

    sizes = {"T": 6, "Z": 3, "C": 2, "Y": 10, "X": 14}  # noqa: RUF012 - nothing writes into it

    def __init__(self, path: Any) -> None:
        self.closed = False

    def read_frame(self, block: int) -> np.ndarray:
        return FRAMES[block // 3, :, block % 3]

    def frame_metadata(self, block: int) -> Any:
        return SimpleNamespace(channels=[SimpleNamespace(time=SimpleNamespace(relativeTimeMs=250.0 * block))])

    def voxel_size(self) -> Any:
        return SimpleNamespace(x=0.25, y=0.25, z=1.0)

    def close(self) -> None:
        self.closed = True


class LifFile:
    """As the library liffile gives a file of two images."""

    def __init__(self, path: Any) -> None:
        stack = FRAMES.transpose(0, 2, 1, 3, 4)
        image = SimpleNamespace(dims=("T", "Z", "λ", "Y", "X"), shape=stack.shape, asarray=lambda out: stack)
        flat = SimpleNamespace(dims=("Y", "X"), shape=stack.shape[3:], asarray=lambda out: stack[0, 0, 0])
        self.images = [flat, image]


def load_video(path: str) -> tuple[np.ndarray, dict[str, Any]]:
    """As pyMRAW gives a recording, by its description."""
    assert path.endswith(".cihx")
    return FRAMES[:, 0, 0], {"Record Rate(fps)": 20000.0}


@pytest.fixture
def libraries(monkeypatch):
    fakes = {"nd2": SimpleNamespace(ND2File=ND2File), "liffile": SimpleNamespace(LifFile=LifFile)}
    fakes["pyMRAW"] = SimpleNamespace(load_video=load_video)
    monkeypatch.setattr(extras, "import_module", lambda name: fakes[name])


def test_nikon(tmp_path, libraries):
    (tmp_path / "s.nd2").write_bytes(b"there")
    with pytest.raises(ValueError, match=r"3 slices and 2 channels, .* \(T 6 x Z 3 x C 2\)"):
        open_frames(tmp_path / "s.nd2")
    source = open_frames(tmp_path / "s.nd2", slice=2, channel=1)
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in source], FRAMES[:, 1, 2])
    assert [frame.time_s for frame in source] == [0.25 * (3 * k + 2) for k in range(6)]
    assert source.um_per_px == (0.25, 0.25)


def test_leica(tmp_path, libraries):
    (tmp_path / "s.lif").write_bytes(b"there")
    with pytest.raises(ValueError, match="holds 2 positions, which are not time"):
        open_frames(tmp_path / "s.lif")
    np.testing.assert_array_equal(stacked(tmp_path / "s.lif", position=1, slice=1, channel=0), FRAMES[:, 0, 1])
    np.testing.assert_array_equal(stacked(tmp_path / "s.lif", position=0), FRAMES[:1, 0, 0])


def test_photron(tmp_path, libraries):
    (tmp_path / "s.mraw").write_bytes(b"there")
    (tmp_path / "s.cihx").write_bytes(b"there")
    source = open_frames(tmp_path / "s.mraw")
    np.testing.assert_array_equal([frame.pixels.numpy() for frame in source], FRAMES[:, 0, 0])
    assert source.fps == 20000
    assert source[3].time_s == pytest.approx(1.5e-4, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("s.nd2", r"s.nd2 needs the library nd2 to be read: pip install 'torch-ecc\[microscopes\]'"),
        ("s.mraw", r"s.mraw needs the library pyMRAW to be read: pip install 'torch-ecc\[photron\]'"),
        ("s.hdf5", r"s.hdf5 needs the library h5py to be read: pip install 'torch-ecc\[arrays\]'"),
        ("s.czi", "s.czi: pylibCZIrw or czifile reads this format: save its frames as TIFF"),
    ],
)
def test_what_is_missing_is_named(tmp_path, monkeypatch, name, message):
    def missing(library: str) -> None:
        raise ImportError(library)

    monkeypatch.setattr(extras, "import_module", missing)
    (tmp_path / name).write_bytes(b"there")
    with pytest.raises(ValueError, match=message):
        open_frames(tmp_path / name)


def test_what_a_library_cannot_read_is_told(tmp_path):
    pytest.importorskip("h5py")
    (tmp_path / "s.h5").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match=r"s\.h5 cannot be read by h5py"):
        open_frames(tmp_path / "s.h5")
