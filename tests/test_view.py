"""What the page shows: marks as settings, rows as curves, the command that repeats it; and whom it is shown to."""

from __future__ import annotations

import http.client
import io
import json
import shlex
import shutil
import subprocess
import sys
import threading
import tomllib
import zipfile
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torch_ecc as te
from torch_ecc import cli
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.options import track_command
from torch_ecc.commands.templates import choose_templates
from torch_ecc.config import fill
from torch_ecc.io.frames import Frame
from torch_ecc.sim.scene.waves import PlaneWaves

pytest.importorskip("starlette", reason="pip install 'torch-ecc[view]'")
pytest.importorskip("uvicorn", reason="pip install 'torch-ecc[view]'")

from torch_ecc.view.desk import Desk
from torch_ecc.view.history import MOST, History
from torch_ecc.view.marks import as_settings, outlook, read_outline
from torch_ecc.view.rois import read_rois
from torch_ecc.view.run import State
from torch_ecc.view.server import Server


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Twelve frames of a patch that moves, and is hidden in the fifth."""
    poses = [(80 + k, 60 - k / 2, 0.01 * k) for k in range(12)]
    stack = PlaneWaves.random(seed=2).render(torch.tensor(poses, dtype=torch.float64), (120, 160))[:, 0]
    stack += torch.randn(stack.shape, generator=torch.Generator().manual_seed(0))
    stack[5] = 90
    path = tmp_path_factory.mktemp("input") / "video.npy"
    np.save(path, stack.round().clamp(0, 255).to(torch.uint8).numpy())
    return path


BOX = {"x": 80, "y": 60, "w": 31, "h": 31}


def run_to_end(desk: Desk) -> None:
    desk.track()
    desk.run._thread.join()


def test_boxes_of_one_size_are_centres_and_all_else_is_outlines():
    assert as_settings([BOX, BOX | {"x": 90}]) == {"centers": [[80, 60], [90, 60]], "size": 31}
    assert as_settings([BOX | {"w": 21}])["size"] == [31, 21]
    outline = {"points": [[70, 50], [90, 50], [80, 70]]}
    assert as_settings([BOX, outline]) == {"polygons": [[[65, 45], [95, 45], [95, 75], [65, 75]], outline["points"]]}


def test_a_box_as_an_outline_covers_the_same_pixels(video):
    frame = torch.from_numpy(np.load(video)[0])
    settings = as_settings([BOX | {"w": 21, "h": 25}, BOX])
    centers, size, mask = choose_templates(fill(TrackJob, {"input": ""} | settings, "test"), frame)
    assert size == (31, 31)
    assert centers.tolist() == [[80, 60], [80, 60]]
    assert mask.sum((1, 2)).tolist() == [21 * 25, 31 * 31]
    assert mask[0, 3:-3, 5:-5].all()


def test_the_outlook_is_texture(video):
    frame = torch.from_numpy(np.load(video)[0])
    flat = frame.clone()
    flat[:, 100:] = (90 + torch.randn(120, 60, generator=torch.Generator().manual_seed(1))).round().to(torch.uint8)
    marks = [BOX, BOX | {"x": 130}, BOX | {"x": 5}]
    good, low, outside = outlook(flat, marks, {})
    assert good.sigma == te.texture(flat, [(80, 60)], 31)[0].tolist()
    assert low == (None, te.Status.describe(te.Status.LOW_TEXTURE))
    assert outside.sigma is None
    assert "must lie in the frame of 160x120 px" in outside.words


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("makePolygon(10,20,30,20,20.5,40);", [[9.5, 19.5], [29.5, 19.5], [20, 39.5]]),
        ("10\t20\n30\t20\n20.5\t40\n", [[9.5, 19.5], [29.5, 19.5], [20, 39.5]]),
        ("X,Y\n10,20\n30,20\n20.5,40", [[9.5, 19.5], [29.5, 19.5], [20, 39.5]]),
        (" \tX\tY\n1\t10\t20\n2\t30\t20\n3\t20.5\t40", [[9.5, 19.5], [29.5, 19.5], [20, 39.5]]),
    ],
)
def test_outlines_of_imagej_are_half_a_pixel_off_ours(text, points):
    assert read_outline(text) == {"points": points}


def test_a_rectangle_of_imagej_is_its_pixels():
    assert read_outline("makeRectangle(10, 20, 31, 25);") == {"x": 25, "y": 32, "w": 31, "h": 25}
    for text in ("", "hello", "makePolygon(1,2)", "3 4"):
        with pytest.raises(ValueError, match="outline: expected a line 'X Y' for each of three corners"):
            read_outline(text)


def archive(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in files.items():
            file.writestr(name, data)
    return packed.getvalue()


def test_files_of_imagej_are_marks():
    """One region or many; a rectangle is its pixels, an outline lies half a pixel off ours."""
    roifile = pytest.importorskip("roifile", reason="pip install 'torch-ecc[view]'")
    polygon = roifile.ImagejRoi.frompoints([[10, 20], [30, 20], [20, 40]])
    fine = roifile.ImagejRoi.frompoints([[10.25, 20], [30, 20], [20.5, 40]])
    box = roifile.ImagejRoi(roitype=roifile.ROI_TYPE.RECT, left=10, top=20, right=41, bottom=45)
    wanted = [
        {"points": [[9.5, 19.5], [29.5, 19.5], [19.5, 39.5]]},
        {"points": [[9.75, 19.5], [29.5, 19.5], [20, 39.5]]},
        {"x": 25, "y": 32, "w": 31, "h": 25},
    ]
    rois = [each.tobytes() for each in (polygon, fine, box)]
    assert [read_rois("a.roi", data) for data in rois] == [[mark] for mark in wanted]
    assert read_rois("all.zip", archive({f"{k}.roi": data for k, data in enumerate(rois)})) == wanted
    line = roifile.ImagejRoi(roitype=roifile.ROI_TYPE.LINE, x1=1, y1=2, x2=3, y2=4).tobytes()
    for data, words in [
        (line, "no rectangle, oval or polygon, but line"),
        (b"Iout and then nothing", "no region of ImageJ's"),
        (b"", "no region of ImageJ's"),
        (b"PK but no archive", "no archive"),
        (archive({"a.txt": b"a"}), "1 to 500 .roi files"),
        (archive({"a.roi": bytes(1 << 21)}), "at most 1 MiB"),
    ]:
        with pytest.raises(ValueError, match=words):
            read_rois("odd", data)


def test_changes_of_marks_are_taken_back_and_made_again(video):
    """Step by step, however a mark came; settings stay, and another change ends what could be made again."""
    desk = Desk({"input": str(video)})
    desk.undo()
    desk.mark([BOX])
    desk.grid(2, 31)
    grid = desk.marks
    desk.set({"um_per_px": 0.5})
    desk.mark([])
    for step, marks in [("undo", grid), ("undo", [BOX]), ("redo", grid), ("undo", [BOX]), ("undo", []), ("undo", [])]:
        getattr(desk, step)()
        assert desk.marks == marks
        assert len(desk.outlooks) == len(marks)
        assert desk.values.get("grid") == (2 if marks is grid else None)
        assert desk.values["um_per_px"] == 0.5
    assert (desk.told()["undo"], desk.told()["redo"]) == (False, True)
    desk.mark([BOX | {"x": 70}])
    assert (desk.told()["undo"], desk.told()["redo"]) == (True, False)


@pytest.mark.parametrize(
    "values",
    [
        {"centers": [[80, 60.5], [90, 50]], "size": 31, "um_per_px": 0.275, "frames": "2:9"},
        {"centers": [[80, 60]], "size": [31, 21], "um_per_px": [0.1, 0.2], "overlay": False, "out": "it is here"},
        {"polygons": [[[70, 50], [90, 50], [80, 70]], [[1, 2], [30, 2], [3, 40.25]]], "force": True, "levels": 2},
        {"grid": 3, "size": 31, "fps": 12.5, "criterion": "ssd", "search": False},
    ],
)
def test_the_command_says_what_the_settings_say(values):
    """It is read back by the command line itself."""
    values = {"input": "a video.npy"} | values
    words = shlex.split(track_command(values))
    assert words[:2] == ["torch-ecc", "track"]
    said = CliRunner().invoke(cli.app, [*words[1:], "--write-config"])
    assert said.exit_code == 0, said.output
    assert fill(TrackJob, tomllib.loads(said.output), "test") == fill(TrackJob, values, "test")


def test_a_run_on_the_desk_is_the_command(video, tmp_path, monkeypatch):
    """The same files, told the same way; a result opened again shows the same rows."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(video, "video.npy")
    desk = Desk({"input": "video.npy", "fps": 50.0, "out": "desk"})
    desk.mark([BOX])
    run_to_end(desk)
    told = desk.told()
    assert told["run"]["state"] == State.DONE
    assert told["files"] == ["track.csv", "track.npz", "summary.json", "track.png", "overlay.mp4"]
    words = shlex.split(told["command"])[1:]
    words[words.index("desk")] = "command"
    done = CliRunner().invoke(cli.app, words)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "desk/track.csv").read_bytes() == (tmp_path / "command/track.csv").read_bytes()
    monkeypatch.chdir(tmp_path.parent)
    again = Desk({"input": str(tmp_path / "command")})
    assert again.problem is None
    assert again.marks == [BOX]
    np.testing.assert_allclose(again.rows.rows, desk.rows.rows, rtol=1e-12)
    np.testing.assert_allclose(again.rows.start, desk.rows.start)
    lost = again.row(5)
    assert lost["row"][2] is None
    assert lost["reasons"] == [te.Reason.describe(te.Reason.FLAT)]
    with pytest.raises(ValueError, match="frame 90 was not tracked"):
        again.row(90)


def test_a_run_is_stopped_and_goes_on(video, tmp_path):
    desk = Desk({"input": str(video), "fps": 50.0, "out": str(tmp_path / "out"), "overlay": False})
    desk.mark([BOX])
    desk.track()
    desk.stop()
    assert desk.told()["run"]["state"] in (State.STOPPED, State.DONE)  # on a fast machine it may have ended
    if desk.run.state is State.STOPPED:
        done = len(desk.rows)
        assert 0 < done < 12
        assert desk.told()["there"] == "unfinished"
        desk.track(resume=True)
        assert len(desk.rows) >= done
        desk.run._thread.join()
    assert desk.run.state is State.DONE
    assert desk.rows.rows[:, 0].tolist() == list(range(12))
    whole = Desk({"input": str(video), "fps": 50.0, "out": str(tmp_path / "whole"), "overlay": False})
    whole.mark([BOX])
    run_to_end(whole)
    np.testing.assert_allclose(desk.rows.rows, whole.rows.rows, rtol=1e-9)
    with pytest.raises(ValueError, match="holds a result already"):
        desk.track()


def test_what_does_not_fit_changes_nothing(video):
    desk = Desk({"input": str(video)})
    desk.mark([BOX])
    before = desk.told() | {"version": 0}
    for call, words in [
        (lambda: desk.set({"frames": "9:3"}), "LAST not to be before FIRST"),
        (lambda: desk.set({"frames": "90:"}), "holds none of the frames"),
        (lambda: desk.set({"fps": -1}), "expected a rate > 0 in Hz, got -1"),
        (lambda: desk.set({"um_per_px": 0}), "finite numbers other than 0, got 0"),
        (lambda: desk.set({"device": "cuda"}), "expected some of frames, fps"),
        (lambda: desk.grid(2, 300), "300x300 px each, in 160x120 px"),
        (lambda: desk.mark([{"x": "left", "y": 0, "w": 9, "h": 9}]), "centers"),
        (lambda: desk.outline("nothing"), "outline"),
        (lambda: desk.rois("nothing.roi", "?"), "nothing.roi is no region"),
        (lambda: desk.picture(90), "has no frame 90"),
    ]:
        with pytest.raises((ValueError, TypeError), match=words):
            call()
        assert desk.told() | {"version": 0} == before
    desk.set({"um_per_px": 0.5, "frames": "3:"})
    assert desk.first == 3
    assert desk.told()["um_matrix"] == [[0.5, 0], [0, 0.5]]


@pytest.mark.parametrize("name", ["broken.png", "broken.tif", "broken.mp4", "missing.avi"])
def test_what_cannot_be_opened_is_a_sentence(tmp_path, name):
    if name != "missing.avi":
        (tmp_path / name).write_bytes(b"this is no picture" * 100)
    told = Desk({"input": str(tmp_path / name)}).told()
    assert name in told["problem"]
    assert json.dumps(told)


def test_long_histories_are_thinned_but_for_what_is_doubted():
    history = History(np.zeros((1, 3)))
    rows = np.zeros((5 * MOST, 12))
    rows[:, 0] = np.arange(len(rows))
    rows[12345, 11] = te.Reason.UNLIKE
    history._rows, history._count = rows, len(rows)
    shown = history.since(0)
    assert MOST <= len(shown) <= MOST + 2
    assert 12345 in shown[:, 0]
    assert (np.diff(shown[:, 0]) > 0).all()
    assert shown[[0, -1], 0].tolist() == [0, len(rows) - 1]
    assert len(history.since(len(rows) - 7)) == 7


@pytest.fixture(scope="module")
def server(video):
    served = Server(Desk({"input": str(video)}))
    threading.Thread(target=served.run, daemon=True).start()
    return served


def asked(server: Server, path: str, **headers: str) -> tuple[int, str]:
    """Status and words of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in ({"Host": f"127.0.0.1:{server.port}"} | headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read().decode("latin-1")


@pytest.mark.parametrize("path", ["", "page/main.js", "frame/0.jpg", "files/track.csv", "link"])
def test_only_the_page_itself_is_served(server, path):
    """Another host (as after a name was rebound), another origin, and whoever has no token."""
    whole = f"{urlsplit(server.url).path}{path}"
    strangers = [{"Host": "example.org"}, {"Host": f"example.org:{server.port}"}, {"Origin": "https://example.org"}]
    for headers in [*strangers, {"Origin": "null"}, {"Origin": f"http://127.0.0.1:{server.port + 1}"}]:
        assert asked(server, whole, **headers)[0] == 403
    for other in (f"/{path}", f"/x{server.token}/{path}", f"/{server.token[:-1]}/{path}"):
        status, words = asked(server, other)
        assert status == 403
        assert "token" in words
    assert server.socket.getsockname()[0] == "127.0.0.1"


def test_the_page_is_served_whole(server):
    status, page = asked(server, urlsplit(server.url).path)
    assert status == 200
    assert "http://" not in page
    assert "https://" not in page
    for name in ("page.css", "main.js", "link.js", "stage.js", "curves.js", "words.js"):
        assert asked(server, f"/{server.token}/page/{name}")[0] == 200
    assert asked(server, f"/{server.token}/files/..%2f..%2fetc%2fpasswd")[0] == 404
    assert asked(server, f"/{server.token}/page/..%2fserver.py")[0] == 404
    assert asked(server, f"/{server.token}/frame/99.jpg") == (422, "video.npy has no frame 99")


def test_without_the_extra_one_sentence_says_what_to_install(video):
    code = (
        "import sys; sys.modules['starlette'] = None\n"
        "sys.argv[1:] = ['pick', sys.argv[1]]\nfrom torch_ecc.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code, str(video)], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.strip() == "torch-ecc: pick: the page needs starlette: pip install 'torch-ecc[view]'"


def test_a_frame_that_is_done_once_more_has_one_row():
    """A run that goes on may begin with a frame that it had."""
    frame = PlaneWaves.random(seed=2).render(torch.tensor([[45.0, 40.0, 0.0]]).double(), (80, 90))[0, 0]
    tracker = te.Tracker(frame, [(45.0, 40.0)], 31)
    history = History(tracker.start.numpy())
    for number in (0, 1, 2, 2, 3):
        history.add(Frame(number, frame), tracker.track(frame))
    assert history.rows[:, 0].tolist() == [0, 1, 2, 3]


def test_numbers_beyond_reason_are_told(data):
    desk = Desk({"input": str(data / "mechanism_video")})
    for call, words in (
        (lambda: desk.grid(10**9, 61), "grid: expected 1 to 163 templates in a row"),
        (lambda: desk.best(0, 61), "best: expected 1 patch or more, got 0"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    assert "larger than the frame" in desk.predict({"points": [[-1e9, -1e9], [1e9, 0], [0, 1e9]]}).words
