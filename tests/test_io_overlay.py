"""The overlay: lines lie where the pose says, colours say what the status says, and no half video has a final name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from test_io_writing import NAMES, Report, names
from torch import Tensor

from torch_ecc.core.pose import transform
from torch_ecc.io import OverlayWriter, open_frames
from torch_ecc.io.beside import ahead, batches
from torch_ecc.io.marks import Mark
from torch_ecc.io.shapes import outlines
from torch_ecc.io.sinks import open_sink

GREY = torch.full((480, 640), 90, dtype=torch.uint8)


def found_at(*poses: tuple[float, float, float], status: tuple[int, ...] = ()) -> Report:
    pose = torch.tensor(poses, dtype=torch.float64)
    count = len(poses)
    codes = torch.tensor(status or (0,) * count, dtype=torch.int8)
    score = torch.full((count,), 0.987)
    covariance = torch.eye(3).expand(count, 3, 3)
    return Report(pose, pose - pose[0], score, codes, torch.full((count,), 4), covariance, score, score, codes, codes)


def drawn(folder: Path, frame: Tensor, *records: Report, shapes=((121, 161),)) -> np.ndarray:
    """The last picture (h, w, 3) in RGB of a sequence of the same frame."""
    with OverlayWriter(folder, shapes=shapes, status_names=NAMES, as_frames=True) as writer:
        for record in records:
            writer.write(frame, record)
    assert writer.path == folder / "overlay"
    *_, last = open_frames(folder / "overlay")
    return last.picture().permute(1, 2, 0).numpy().astype(int)


def coloured(picture: np.ndarray) -> np.ndarray:
    """Where a picture of a grey frame is not grey."""
    return np.ptp(picture, axis=-1) > 60


# ---- where lines lie -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pose", [(320.0, 240.0, 0.0), (301.3, 251.7, 0.4), (320.5, 239.5, -2.5), (320.0, 240.0, 7.0)])
def test_the_outline_lies_where_the_pose_says(tmp_path, pose):
    picture = drawn(tmp_path, GREY, found_at(pose))
    (corners,) = outlines((121, 161))
    where = transform(torch.tensor(pose, dtype=torch.float64), corners).numpy()
    ends = np.roll(where, -1, axis=0)
    along = np.concatenate([where + s * (ends - where) for s in np.linspace(0.05, 0.95, 40)])
    x, y = np.round(along).astype(int).T
    assert coloured(picture)[y, x].mean() > 0.97
    inside = np.concatenate([0.8 * corners.numpy(), 1.2 * corners.numpy()])
    x, y = np.round(transform(torch.tensor(pose, dtype=torch.float64), torch.from_numpy(inside)).numpy()).astype(int).T
    assert not coloured(picture)[y, x].any()


@pytest.mark.parametrize(("theta", "tip"), [(0.0, (1, 0)), (math.pi / 2, (0, -1)), (math.pi, (-1, 0))])
def test_the_arrow_is_the_x_axis_of_the_template(tmp_path, theta, tip):
    """A positive theta turns it upwards on the screen."""
    picture = coloured(drawn(tmp_path, GREY, found_at((320.0, 240.0, theta))))
    x, y = 320 + 20 * tip[0], 240 + 20 * tip[1]
    assert picture[y, x]
    assert not picture[480 - y - (tip[1] == 0) * 9, 640 - x - (tip[0] == 0) * 9]
    assert not picture[240 - 20 * tip[1], 320 - 20 * tip[0]]


def test_lines_are_placed_between_the_pixels(tmp_path):
    """The middle of a vertical line follows the pose to a tenth of a pixel."""
    middles = []
    for k, x in enumerate(np.arange(320, 321, 0.125)):
        picture = drawn(tmp_path / str(k), GREY, found_at((float(x), 240.0, 0.0)))
        row = picture[215, 380:420, 1] - picture[215, 380:420, 0]  # green of the right edge, above the arrow
        middles.append((row * np.arange(380, 420)).sum() / row.sum() - 80.5)
    np.testing.assert_allclose(middles, np.arange(320, 321, 0.125), atol=0.15)


def test_small_frames_are_enlarged(tmp_path):
    frame = torch.arange(60, dtype=torch.uint8).expand(50, 60)
    picture = drawn(tmp_path, frame, found_at((30.0, 25.0, 0.0)), shapes=[(21, 21)])
    zoom = picture.shape[0] // 50
    assert picture.shape == (50 * zoom, 60 * zoom, 3)
    assert zoom >= 8
    np.testing.assert_array_equal(picture[200, ::zoom, 0][:15], np.arange(15))
    x = (30 + 10.5 + 0.5) * zoom - 0.5
    assert coloured(picture)[int(25 * zoom), round(x)]


def test_the_trail_is_the_path_so_far_and_stops_when_lost(tmp_path):
    path = [found_at((300.0 + 4 * k, 240.0 + 40 * math.sin(k / 3), 0.0)) for k in range(20)]
    lost = [found_at((376.0, 240.0, 0.0), status=(2,))] * 5
    picture = drawn(tmp_path, GREY, *path, *lost)
    blue = picture[..., 2] - picture[..., 0] > 60
    for k in (2, 6, 12):
        x, y = path[k].pose[0, :2].round().int().tolist()
        assert blue[y - 2 : y + 3, x - 2 : x + 3].any()


def test_a_mask_is_drawn_around_its_pixels():
    y, x = torch.meshgrid(torch.arange(61), torch.arange(81), indexing="ij")
    ring = ((x - 40) ** 2 + (y - 30) ** 2 <= 25**2) & ((x - 40) ** 2 + (y - 30) ** 2 >= 10**2)
    outer, inner = sorted(outlines(ring), key=lambda line: -float(line.norm(dim=1).max()))
    np.testing.assert_allclose(outer.norm(dim=1), 25, atol=1)
    np.testing.assert_allclose(inner.norm(dim=1), 10, atol=1.5)
    square = torch.zeros(31, 41, dtype=torch.bool)
    square[10:21, 5:16] = True
    (line,) = outlines(square)
    assert sorted(line.tolist()) == [[-15, -5], [-15, 5], [-5, -5], [-5, 5]]


# ---- what colours and words say ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "colour"), [(0, (70, 225, 90)), (1, (255, 165, 0)), (2, (255, 70, 70)), (3, (255, 70, 70))]
)
def test_the_colour_is_the_status(tmp_path, status, colour):
    picture = drawn(tmp_path, GREY, found_at((320.0, 240.0, 0.0), status=(status,)))
    # On the upper edge, which lies between two rows of pixels.
    edge = picture[178:182, 330]
    assert np.abs(edge - colour).sum(-1).min() < 60


def test_labels_do_not_cover_each_other_or_leave_the_frame(tmp_path):
    """Two that touched would be one dark patch; each is about as large as the first (numbers differ in width)."""
    poses = [(50.0 + 200 * i, 30.0 + 140 * j, 0.1) for i in range(3) for j in range(4)]
    picture = drawn(tmp_path, GREY, found_at(*poses), shapes=[(41, 41)] * 12)
    number, _, stats, _ = cv2.connectedComponentsWithStats((picture.max(-1) < 40).astype(np.uint8))
    sizes = [(stat[cv2.CC_STAT_WIDTH], stat[cv2.CC_STAT_HEIGHT]) for stat in stats[1:number]]
    labels = np.array([size for size in sizes if size[0] > 100])
    assert len(labels) == 12
    np.testing.assert_allclose(labels, labels[:1].repeat(12, 0), atol=15)


def test_a_crowd_gets_outlines_and_what_is_wrong_its_number(tmp_path):
    """Numbers that hide what they number are of no use; of three that are few enough they are there."""
    poses = [(30.0 + 40 * i, 40.0 + 40 * j, 0.0) for i in range(15) for j in range(11)]
    shapes, record = [(31, 31)] * len(poses), found_at(*poses)
    whole = drawn(tmp_path / "a", GREY, record, shapes=shapes)
    status = record.status.clone()
    status[7] = 2
    wrong = drawn(tmp_path / "b", GREY, record._replace(status=status), shapes=shapes)
    few = drawn(tmp_path / "c", GREY, found_at(*poses[:3]), shapes=shapes[:3])
    dark = [(picture[:60, :160].max(-1) < 40).mean() for picture in (whole, few)]
    assert (whole.max(-1) < 40).mean() < 0.2
    assert dark[0] < 0.6 * dark[1]
    x, y, _ = poses[7]
    near = np.abs(wrong.astype(int) - whole)[int(y) - 40 : int(y), int(x) - 20 : int(x) + 80]
    assert (near.max(-1) > 30).mean() > 0.1


# ---- frames of any kind --------------------------------------------------------------------------------------------


def test_deep_frames_are_stretched_by_the_first_one(tmp_path):
    ramp = torch.linspace(0, 1, 640).expand(480, 640)
    record = found_at((320.0, 240.0, 0.0))
    pictures = [
        drawn(tmp_path / "u16", (ramp * 3000 + 500).to(torch.uint16), record),
        drawn(tmp_path / "f32", ramp * 1e-3 - 5.0, record),
        drawn(tmp_path / "rgb", (ramp * 1e4).expand(3, 480, 640), record),
    ]
    wanted = np.linspace(0, 255, 640)
    for picture in pictures:
        np.testing.assert_allclose(picture[20, :, 0], wanted, atol=2)
    with OverlayWriter(tmp_path / "two", shapes=[(121, 161)], status_names=NAMES, as_frames=True) as writer:
        writer.write(ramp, record)
        writer.write(ramp / 2, record)
    _, second = open_frames(tmp_path / "two" / "overlay")
    np.testing.assert_allclose(second.picture()[0, 20], wanted / 2, atol=2)


def test_8_bit_frames_stay_as_they_are(tmp_path):
    frame = torch.stack([torch.full((480, 640), value, dtype=torch.uint8) for value in (30, 31, 32)])
    picture = drawn(tmp_path, frame, found_at((320.0, 240.0, 0.0)))
    assert picture[20, 20].tolist() == [30, 31, 32]


def test_a_constant_frame_can_be_shown(tmp_path):
    drawn(tmp_path, torch.full((480, 640), 0.5), found_at((320.0, 240.0, 0.0)))


# ---- the files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fps", [None, 0.01, 29.97, 1234.567])
@pytest.mark.parametrize("size", [(480, 640), (481, 633)])
def test_video(tmp_path, size, fps):
    frame = torch.full(size, 90, dtype=torch.uint8)
    with OverlayWriter(tmp_path, shapes=[(121, 161)], status_names=NAMES, fps=fps) as writer:
        for k in range(6):
            writer.write(frame, found_at((320.0 + k, 240.0, 0.0)))
            assert names(tmp_path) <= {"overlay.h264.part"}
    assert names(tmp_path) == {"overlay.mp4"}
    assert writer.path == tmp_path / "overlay.mp4"
    source = open_frames(writer.path)
    assert len(list(source)) == 6
    assert source.shape == (480 + 2 * (size[0] % 2), 640 - 6 * (size[1] % 2))
    assert source.fps == pytest.approx({None: 25.0, 0.01: 0.1, 1234.567: 1000.0}.get(fps, fps))


def test_browsers_play_the_video(tmp_path):
    """H.264 of 8 bits with halved chroma, its index at the front, key pictures to jump to, and every picture there."""
    with OverlayWriter(tmp_path, shapes=[(121, 161)], status_names=NAMES, fps=50.0) as writer:
        for k in range(120):
            writer.write(GREY, found_at((320.0 + k, 240.0, 0.0)))
    with av.open(str(writer.path)) as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.frames) == ("h264", "yuv420p", 120)
        packets = [packet for packet in film.demux(stream) if packet.size]
        assert [packet.pts * packet.time_base for packet in packets] == [Fraction(k, 50) for k in range(120)]
        assert max(np.diff([k for k, packet in enumerate(packets) if packet.is_keyframe])) <= 50
    data = writer.path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_micrometres_are_in_the_label(tmp_path):
    """Where the scale is known: one line more."""
    heights = []
    for um in (None, torch.diag(torch.tensor([0.3, -0.3]))):
        folder = tmp_path / str(um is None)
        with OverlayWriter(folder, shapes=[(121, 161)], status_names=NAMES, um_matrix=um, as_frames=True) as writer:
            writer.write(GREY, found_at((320.0, 300.0, 0.0)))
        (picture,) = (frame.picture() for frame in open_frames(folder / "overlay"))
        heights.append(int((picture.amax(0)[100:235, 245:440] < 60).any(1).sum()))
    assert heights[1] > 1.3 * heights[0]
    mark = Mark(0, np.zeros(3), np.eye(2, 3), 1.0, "CONVERGED", [], [], np.array([1.25, -0.5]))
    assert "Δx +1.250 µm   Δy -0.500 µm" in mark.text("above")


def test_what_fails_behind_is_told(tmp_path, monkeypatch):
    """Pictures are written on another thread: an error there ends the run here, soon."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torch_ecc.io.sinks.append", full)

    def run() -> None:
        with OverlayWriter(tmp_path, shapes=[(121, 161)], status_names=NAMES) as writer:
            for k in range(100):
                writer.write(GREY, found_at((320.0 + k, 240.0, 0.0)))

    with pytest.raises(OSError, match="No space left"):
        run()
    assert "overlay.mp4" not in names(tmp_path)


def test_reading_ahead_keeps_order_and_errors():
    def items() -> Iterator[int]:
        yield from range(100)
        raise ValueError("the end")

    seen = []
    with pytest.raises(ValueError, match="the end"):  # noqa: PT012
        for item in ahead(items()):
            seen.append(item)  # noqa: PERF402
    assert seen == list(range(100))
    seen = []
    with pytest.raises(ValueError, match="the end"):  # noqa: PT012
        for some in batches(items(), 8):
            seen.append(some)
    assert [len(some) for some in seen] == [*[8] * 12, 4]
    assert [item for some in seen for item in some] == list(range(100))
    stream = ahead(iter(range(10**9)))
    assert next(stream) == 0
    stream.close()


def test_frames_where_no_video_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"png"})
    with OverlayWriter(tmp_path, shapes=[(121, 161)], status_names=NAMES) as writer:
        writer.write(GREY, found_at((320.0, 240.0, 0.0)))
    assert writer.path == tmp_path / "overlay"
    assert names(tmp_path) == {"overlay"}
    assert names(tmp_path / "overlay") == {"frame_000000.png"}


@pytest.mark.parametrize("as_frames", [False, True])
def test_what_was_drawn_is_kept(tmp_path, as_frames):
    def run() -> None:
        with OverlayWriter(tmp_path, shapes=[(121, 161)], status_names=NAMES, as_frames=as_frames) as writer:
            for k in range(4):
                writer.write(GREY, found_at((320.0 + k, 240.0, 0.0)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert names(tmp_path) == {"overlay" if as_frames else "overlay.mp4"}
    assert len(list(open_frames(tmp_path / names(tmp_path).pop()))) == 4


def test_nothing_is_created_before_the_first_frame(tmp_path):
    with OverlayWriter(tmp_path / "out", shapes=[(3, 3)], status_names=NAMES) as writer:
        pass
    assert writer.path is None
    assert not (tmp_path / "out").exists()


def test_frames_of_an_earlier_run_are_replaced_and_other_files_stay(tmp_path):
    record = found_at((320.0, 240.0, 0.0))
    drawn(tmp_path, GREY, record, record, record)
    (tmp_path / "overlay" / "mine.txt").write_text("mine")
    (tmp_path / "overlay.part").mkdir()
    (tmp_path / "overlay.part" / "frame_000009.png").write_text("of a killed run")
    drawn(tmp_path, GREY, record)
    assert names(tmp_path / "overlay") == {"frame_000000.png", "mine.txt"}
    assert names(tmp_path) == {"overlay"}


# ---- refused at the door -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((0, 5), r"shape must be \(h, w\) in px, both positive, got \(0, 5\)"),
        (torch.zeros(5, 5), r"a mask must be \(h, w\) and not empty, got \(5, 5\)"),
        (torch.ones(1, 5, 5), r"a mask must be \(h, w\) and not empty, got \(1, 5, 5\)"),
    ],
)
def test_bad_shapes(tmp_path, shape, message):
    with pytest.raises(ValueError, match=message):
        OverlayWriter(tmp_path, shapes=[shape], status_names=NAMES)


@pytest.mark.parametrize(
    ("frame", "record", "message"),
    [
        (torch.zeros(2, 480, 640), found_at((9.0, 9.0, 0.0)), r"frame must be .* got \(2, 480, 640\)"),
        (GREY[:100], found_at((9.0, 9.0, 0.0)), r"frame must be \(480, 640\) as before, got \(100, 640\)"),
        (GREY, found_at((9.0, 9.0, 0.0), (9.0, 9.0, 0.0)), "record must have 1 templates as shapes, got 2"),
    ],
)
def test_bad_frames(tmp_path, frame, record, message):
    with OverlayWriter(tmp_path, shapes=[(5, 5)], status_names=NAMES, as_frames=True) as writer:
        writer.write(GREY, found_at((9.0, 9.0, 0.0)))
        with pytest.raises(ValueError, match=message):
            writer.write(frame, record)
    assert names(tmp_path / "overlay") == {"frame_000000.png"}


@pytest.mark.parametrize("size", [(450, 480), (452, 480), (405, 407)], ids=str)
def test_a_video_shows_what_was_drawn(size, tmp_path):
    """Brightness and colours, whatever its size."""
    low = np.random.default_rng(0).integers(40, 200, (6, 6, 3), dtype=np.uint8)
    drawn = cv2.resize(low, size[::-1], interpolation=cv2.INTER_CUBIC)
    sink = open_sink(tmp_path, "film", 25.0, 0, as_frames=False)
    for _ in range(3):
        sink.write(drawn)
    with av.open(str(sink.close(keep=False))) as film:
        shown = [frame.to_ndarray(format="bgr24") for frame in film.decode(video=0)]
    assert len(shown) == 3
    apart = shown[-1][: size[0], : size[1]].astype(int) - drawn
    assert np.abs(apart).mean() < 5
