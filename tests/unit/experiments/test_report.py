"""Reports: what is in them, in each of their forms."""

import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from onedemo.experiments.report.blocks import (
    Bars,
    Bullets,
    Chart,
    Document,
    Heading,
    Line,
    Picture,
    Reference,
    Table,
    Text,
    number,
    numeric_columns,
)
from onedemo.experiments.report.document import about, as_text, plain, write

X = np.linspace(0, 3e6, 30)


def chart(**changes):
    lines = [
        Line(label="ours", x=X, y=X / 1e6, low=X / 2e6, high=X / 0.8e6, each=[X / 2e6, X / 0.8e6]),
        Line(label="theirs <&>", x=X, y=X / 1.01e6, dashed=True),
    ]
    settings = {
        "name": "turns", "title": "Net turns", "x_label": "environment steps", "y_label": "turns",
        "lines": lines, "references": [Reference(label="the paper", y=2, x=1e6), Reference(label="r", y=4)],
    }  # fmt: skip
    return Chart(**(settings | changes))


def bars():
    return Bars(
        name="parts", title="Parts", x_label="turns", labels=["all", "one", "none"], values=[4, 2, None],
        each=[[3, 5], [2], []], reference=Reference(label="the paper", y=2), strong=["all"],
    )  # fmt: skip


def document(*more):
    table = Table(
        title="Table 2",
        heads=("method", "reward", "turns", "remark"),
        rows=[("**ours**", 8012.4, "6.1 ± 0.8", "a|b"), ("theirs", None, "not run", "<3")],
        notes=["± over seeds."],
    )
    blocks = [
        Text("See [how](method.md), `code` & all."),
        Heading("Figures"),
        table,
        Bullets(["one", "**two**"]),
    ]
    return Document(
        title="A <report>",
        blocks=[*blocks, Bullets(["one", "**two**"]), *more],
        about=about(command="onedemo bench x --seeds 5", method_versions={"method": 3}),
        data={"figures": np.arange(3), "missing": float("nan")},
    )


def test_markdown(tmp_path):
    write(document(Picture(name="strip.png", data=b"png", alt="frames")), tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# A <report>\n\n`onedemo bench x --seeds 5`, onedemo 0.")
    for part in (
        "| method | reward | turns | remark |\n|---|---:|---:|---|\n| **ours** | 8,012 |",
        " | 6.1 ± 0.8 | a\\|b |\n",
        "| theirs |  | not run | <3 |",
        "## Figures", "- one\n- **two**", "![frames](strip.png)", "± over seeds.",
        "method versions: method 3.",
    ):  # fmt: skip
        assert part in text
    assert (tmp_path / "strip.png").read_bytes() == b"png"


def test_json_has_what_was_typed_and_no_nan(tmp_path):
    write(document(), tmp_path)
    results = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert results["command"] == "onedemo bench x --seeds 5" and results["method_versions"] == {"method": 3}
    assert results["figures"] == [0, 1, 2] and results["missing"] is None
    assert results["machine"]["cores"] >= 1 and results["date"].startswith("20")


def test_plain_refuses_what_json_does_not_know():
    assert plain({1: (np.float32(0.5), np.int64(3), True, "x", np.inf)}) == {"1": [0.5, 3, True, "x", None]}
    with pytest.raises(TypeError, match="a set"):
        plain([{1}])


def test_text():
    text = as_text(document(Picture(name="strip.png", data=b"png", alt="frames")))
    assert "method  reward      turns  remark\nours     8,012  6.1 ± 0.8  a|b\n" in text
    assert "See how, code & all." in text and "- two" in text and "**" not in text


def test_numbers():
    assert [number(x) for x in (0, 0.12345, 12.345, 999.6, 1234567.8, -2.5)] == [
        "0", "0.123", "12.3", "1000", "1,234,568", "-2.5",
    ]  # fmt: skip
    rows = [(1.0, "x", ">= 2", "", "1,200 s", "0, 1"), (None, "2", "3 - 4", "", "not run", "0, 1, 2")]
    assert numeric_columns("abcdef", rows) == [True, False, True, False, True, False]


def texts(svg):
    return [element.text for element in ElementTree.fromstring(svg).iter() if element.tag.endswith("}text")]


def test_charts_name_their_lines_axes_and_references():
    drawing = pytest.importorskip("onedemo.experiments.report.drawing")
    found = texts(drawing.draw(chart()))
    assert {"Net turns", "environment steps", "turns", "ours", "theirs <&>", "the paper", "r", "1M"} <= {
        *found
    }
    assert {"ours", "theirs <&>"} <= {*texts(drawing.draw(chart(wide=False, log_y=False)))}
    found = texts(drawing.draw(bars()))
    assert {"Parts", "all", "one", "none", "not run", "the paper", "4", "2"} <= {*found}


def test_the_same_chart_is_the_same_file(tmp_path):
    pytest.importorskip("matplotlib")
    report = document(chart(), bars(), chart(name="half", wide=False, log_x=True, lines=[
        Line(label="one", x=[1, 10, 100], y=[1, 2, 3], marks=True)
    ], references=()))  # fmt: skip
    for name in ("a", "b"):
        write(report, tmp_path / name)
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == ["half.svg", "parts.svg", "report.md", "results.json", "turns.svg"]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert "dc:date" not in (tmp_path / "a/turns.svg").read_text()


def test_names_at_line_ends_do_not_touch():
    drawing = pytest.importorskip("onedemo.experiments.report.drawing")
    places = drawing._apart(np.array([0.1, 0.5, 0.51, 0.52]), 0.1)
    assert np.diff(places).min() > 0.1 - 1e-9
    assert places[0] == pytest.approx(0.1) and np.mean(places[1:]) == pytest.approx(0.51)
