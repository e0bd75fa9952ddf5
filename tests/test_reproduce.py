"""``torch-ecc reproduce``: what is written, what the report holds, what interruption and wrong names leave."""

from __future__ import annotations

import base64
import json
import sys
from html.parser import HTMLParser
from importlib import import_module

import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

from torch_ecc.cli import app, main
from torch_ecc.paper import reproduce
from torch_ecc.paper.report import write_report
from torch_ecc.paper.result import Experiment, Number, Picture, Table, load_records

QUICK, FULL = ({"quick": quick, "seconds": 2.0, "cpu_seconds": 1.0} for quick in (True, False))
PNG = b"\x89PNG\r\n\x1a\n"


def outcome(name: str = "fig2", pictures: tuple[str, ...] = ("curve",), remark: str = "All is well.") -> Experiment:
    records = [
        Number("kept", 0.5, "px", tolerance=1.0, paper=0.7),
        Number("missed", 2.0, "px", tolerance=1.0),
        Number("just told", float("inf"), "1", better="higher"),
    ]
    drawn = [Picture(p, Figure(figsize=(1, 1)), f"caption of {p}") for p in pictures]
    return Experiment(name, f"Title of {name}", drawn, [Table("Rows", ("a", "b"), [("1", "2")])], records, [remark], 7)


class Page(HTMLParser):
    """Tags that must be closed are; attributes that could fetch something are collected."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def read(path) -> Page:
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


def test_records_are_strict_json_with_what_they_depend_on(tmp_path):
    reproduce.save(outcome(), tmp_path, QUICK)

    def refuse(word: str) -> None:
        raise AssertionError(word)

    document = json.loads((tmp_path / "records.json").read_text(), parse_constant=refuse)
    assert document["quick"] is True
    assert document["seed"] == 7
    assert document["environment"].keys() >= {"torch", "torch_ecc", "machine", "threads"}
    kept, missed, told = document["records"]
    assert (kept["kept"], missed["kept"], told["value"]) == (True, False, None)
    assert kept["paper"] == 0.7
    assert document["pictures"] == [{"file": "curve.png", "caption": "caption of curve"}]


def test_pictures_of_an_earlier_run_do_not_stay(tmp_path):
    reproduce.save(outcome(pictures=("a", "b")), tmp_path, FULL)
    (tmp_path / "mine.png").write_bytes(b"not ours")
    reproduce.save(outcome(pictures=("b", "c")), tmp_path, QUICK)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.png", "c.png", "mine.png", "records.json"]


def test_report_is_one_self_contained_page(tmp_path):
    for name in ("fig2", "fig3"):
        reproduce.save(outcome(name, ("p", "q")), tmp_path / name, QUICK)
    write_report(tmp_path / "report.html", [tmp_path / n / "records.json" for n in ("fig2", "fig3")])
    page = read(tmp_path / "report.html")
    links = [link for link in page.fetched if link.startswith("#")]
    pictures = [source for source in page.fetched if source not in links]
    assert links == ["#fig2", "#fig3"]
    assert len(pictures) == 4
    for source in pictures:
        head, data = source.split(",", 1)
        assert head == "data:image/png;base64"
        assert base64.b64decode(data).startswith(PNG)
    assert not {"script", "link", "iframe"} & set(page.tags)
    for words in ("Title of fig2", "caption of q", "All is well.", "0.7 px", "✓ kept", "✗ not kept", "1 of 2"):
        assert words in page.text, words


def test_report_escapes_every_text(tmp_path):
    nasty = "<script>alert('x')</script> & <b>\"bold\"</b>"
    o = outcome(remark=nasty)._replace(title=nasty, tables=[Table(nasty, (nasty,), [(nasty,)], nasty)])
    o = o._replace(records=[Number(nasty, 1.0, "<i>", tolerance=2.0), Number(nasty, 1.0, "<i>")])
    o = o._replace(pictures=[o.pictures[0]._replace(caption=nasty)])
    reproduce.save(o, tmp_path / "fig2", QUICK)
    write_report(tmp_path / "report.html", [tmp_path / "fig2" / "records.json"])
    page = read(tmp_path / "report.html")
    assert not {"script", "i"} & set(page.tags)
    assert page.text.count(nasty) == 10  # overview, heading, caption, remark, table of four, two numbers


def test_run_keeps_what_was_done_and_an_interruption_loses_only_what_was_going_on(tmp_path):
    last = "fig3"
    reproduce.save(outcome(last), tmp_path / last, FULL)
    reproduce.run("fig2", tmp_path, True, lambda done, total: None)
    before = read(tmp_path / "report.html").fetched
    assert {"#fig2", f"#{last}"} <= set(before)

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduce.run(last, tmp_path, True, interrupt)
    assert read(tmp_path / "report.html").fetched == before
    assert load_records(tmp_path / last / "records.json")["title"] == f"Title of {last}"
    assert not list(tmp_path.rglob("*.part"))


def test_every_name_is_an_experiment():
    for name in reproduce.NAMES:
        assert callable(import_module(f"torch_ecc.paper.{name}").run)


def test_names_are_put_in_order_once():
    assert reproduce.chosen([*reversed(reproduce.NAMES), "fig2"]) == list(reproduce.NAMES)
    assert reproduce.chosen(["fig2", "all"]) == list(reproduce.NAMES)
    assert reproduce.chosen(["fig2"]) == ["fig2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fig2", "fig99"], "expected one of fig2"),
        (["fig2", "fig99"], "got 'fig99'"),
        ([], "got none"),
        (["fig2", "--out", "FILE"], "out_dir must be a folder"),
    ],
)
def test_wrong_input_is_one_line_before_any_work(arguments, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "FILE").write_text("mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["torch-ecc", "reproduce", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    said = capsys.readouterr().err
    assert caught.value.code == 2
    assert message in said
    assert [p.name for p in tmp_path.iterdir()] == ["FILE"]


def test_the_command_says_what_was_kept(tmp_path):
    done = CliRunner().invoke(app, ["reproduce", "fig2", "--quick", "--out", str(tmp_path / "r")])
    assert done.exit_code == 0, done.output
    assert "fig2: 2 of 2 numbers are within their limits" in done.output
    assert f"Report: {tmp_path}/r/report.html" in done.output
    (picture,) = load_records(tmp_path / "r" / "fig2" / "records.json")["pictures"]
    assert (tmp_path / "r" / "fig2" / picture["file"]).read_bytes().startswith(PNG)


def test_ctrl_c_is_said_in_words(tmp_path, monkeypatch):
    def stopped(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce, "run", stopped)
    done = CliRunner().invoke(app, ["reproduce", "all", "--out", str(tmp_path)])
    assert done.exit_code == 130
    assert "Stopped from the keyboard. What was finished before is in" in done.output
