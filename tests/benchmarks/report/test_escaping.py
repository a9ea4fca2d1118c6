"""One hostile alphabet through every format, read back by a parser of that format."""

import csv
import io
import re
import xml.etree.ElementTree as ElementTree

import pytest
from helpers.hostile import HOSTILE, Text
from jinja2 import Environment
from markdown_it import MarkdownIt

from benchmarks.report import escaping


def words(text: str) -> str:
    return " ".join(escaping.one_line(text).split())


@pytest.mark.parametrize("text", HOSTILE)
def test_markdown_shows_the_text_and_nothing_else(text: str) -> None:
    reader = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    paragraph = Text(reader.render(escaping.markdown(text)))
    assert words(paragraph.text) == words(text) and paragraph.tags == ["p"]
    row = Text(reader.render(f"| a | b |\n|---|---|\n| {escaping.markdown(text)} | end |"))
    assert words(row.text) == f"a b {words(text)} end" and row.tags.count("td") == 2
    assert set(row.tags) == {"table", "thead", "tbody", "tr", "th", "td"}


@pytest.mark.parametrize("text", ["see @someone", "fixes #12", "https://a.b/c", "www.a.b"])
def test_github_finds_nothing_to_link(text: str) -> None:
    pieces = re.split("<!-- -->", escaping.markdown(text))
    assert not any(re.search(r"@\w|#\d|https?://|www\.", piece) for piece in pieces)


@pytest.mark.parametrize("text", HOSTILE)
def test_latex_has_only_commands_of_ours(text: str) -> None:
    found = escaping.latex(text)
    for ours in sorted(map(str, escaping.TEX.values()), key=len, reverse=True):
        found = found.replace(ours, "")
    assert not set(found) & set("\\{}$&%#_^~<>|\"'`-\n")


def test_latex_says_every_character_once() -> None:
    assert escaping.latex("a\\b{c}") == r"a\textbackslash{}b\{c\}"
    assert escaping.latex("50 % ± 1 --x") == r"50 \% $\pm$ 1 {-}{-}x"


@pytest.mark.parametrize("text", HOSTILE)
def test_a_spreadsheet_sees_no_formula(text: str) -> None:
    buffer = io.StringIO()
    csv.writer(buffer).writerow([escaping.csv_text(text), "end"])
    (row,) = csv.reader(io.StringIO(buffer.getvalue()))
    assert row[1] == "end" and not row[0].startswith(("=", "+", "-", "@", "\t", "\r"))
    assert row[0].removeprefix("'") == escaping.one_line(text).removeprefix("'")


@pytest.mark.parametrize("text", HOSTILE)
def test_xml_holds_the_text_in_elements_and_attributes(text: str) -> None:
    root = ElementTree.fromstring(f'<a b="{escaping.xml(text)}">{escaping.xml(text)}</a>')
    assert root.text == root.attrib["b"] == escaping.one_line(text) and len(root) == 0


@pytest.mark.parametrize("text", HOSTILE)
def test_the_page_s_templates_escape_by_themselves(text: str) -> None:
    from benchmarks.report.page import environment

    assert isinstance(environment("html"), Environment)
    page = Text(environment("html").from_string("<p title='{{ text }}'>{{ text }}</p>").render(text=text))
    assert page.tags == ["p"] and words(page.text) == words(text)
