"""Templates: whatever people write is text, and nothing is left out in silence."""

import re

import pytest
from jinja2 import UndefinedError

from helpers.paths import ROOT
from onedemo.app.templates import render
from onedemo.app.templates.render import environment

FILES = sorted(file.name for file in (ROOT / "app" / "templates").glob("*.html"))
assert len(FILES) > 8
HOSTILE = "<img src=x onerror=alert(1)> & \"'"
ESCAPED = "&lt;img src=x onerror=alert(1)&gt; &amp; &#34;&#39;"


def test_a_value_is_escaped_in_text_and_in_attributes():
    page = render("login.html", base="", note=HOSTILE, token=HOSTILE, days=30)
    assert f'<p class="note" role="alert">{ESCAPED}</p>' in page and f'value="{ESCAPED}"' in page
    assert HOSTILE not in page and "<img src=x" not in page


def test_markup_of_another_template_is_escaped_once():
    player = render("watch.html:frame", source=HOSTILE)
    example = {"rating": 5, "why": "<b>"}
    guide = render(
        "guide.html:guide", scale=[("Not", "at all")], cards=[(player, example)], words=[], video="", keys=[],
        loading=False,
    )  # fmt: skip
    assert str(player) in guide and "<span>&lt;b&gt;</span>" in guide


def test_a_missing_value_is_an_error():
    with pytest.raises(UndefinedError, match="days"):
        render("login.html", base="", note="", token="abc")
    with pytest.raises(UndefinedError, match="source"):
        render("watch.html:frame")
    with pytest.raises(TypeError, match="sauce"):
        render("watch.html:frame", source="", sauce="")


def test_what_is_empty_is_empty_to_the_style_sheet():
    assert render("parts.html:nobody", ratings=0, learned=0) == ""


@pytest.mark.parametrize("name", FILES)
def test_a_template_compiles_and_trusts_nobody(name):
    environment().get_template(name)
    source = (ROOT / "app" / "templates" / name).read_text()
    assert not re.search(r"\|\s*safe\b|autoescape", source)
    assert not re.search(r"<[^>]*\son\w+\s*=", source), "an inline event handler"
    assert not re.search(r"<script(?![^>]*\ssrc=)|javascript:", source), "an inline script"


@pytest.mark.parametrize(
    ("filter", "values"),
    [
        ("number", [(None, "–"), (0, "0"), (1.25, "1.25")]),
        ("steps", [(0, "0"), (9_999, "9999"), (10_000, "10 k"), (1_234_567, "1.23 M")]),
    ],
)
def test_filters(filter, values):
    for value, text in values:
        assert environment().filters[filter](value) == text
    written = environment().filters["number"]
    assert written(1234.56, ",.1f") == "1,234.6"
    assert [written(value, "+.1f") for value in (-0.04, 0.04, -0.06)] == ["0.0", "0.0", "-0.1"]
