"""Texts of others (names of methods, reasons of failures, paths) inside formats that would read them as commands.

One function per format, each for a piece of text on one line. HTML escapes itself: its template does so everywhere.
"""

import re
from xml.sax.saxutils import escape

CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]+")
# GitHub makes links of these after it has read the Markdown; an empty comment keeps them apart.
LINKED = re.compile(r"(?<=[@#])(?=\w)|(?<=:)(?=//)|(?<=www)(?=\.)", re.IGNORECASE)
MARKER = re.compile(
    r"^(?:[-+](?=\s|$)|#{1,6}(?=\s|$)|[-=]+$|\d{1,9}(?=[.)](?:\s|$)))"
)  # what opens a block in Markdown
TEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "&": r"\&",
        "%": r"\%",
        "#": r"\#",
        "_": r"\_",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        '"': r"\textquotedbl{}",
        "'": r"\textquotesingle{}",
        "`": r"\textasciigrave{}",
        "-": "{-}",  # Two in a row would be a dash.
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "±": r"$\pm$",
        "\N{MINUS SIGN}": "$-$",
        "\u2009": r"\,",
    }
)


def one_line(text: str) -> str:
    """The text without line breaks and other control characters."""
    return CONTROLS.sub(" ", text).strip()


def markdown(text: str) -> str:
    """For a paragraph, an item or a table's cell of GitHub's Markdown: no markup, HTML, link, mention or formula."""
    plain = one_line(text)
    marker = MARKER.match(plain)
    escaped = re.sub(r"[\\`*_\[\]|~$]", r"\\\g<0>", LINKED.sub("\0", plain))
    if marker:
        at = marker.end() if plain[0].isdigit() else 0
        escaped = f"{escaped[:at]}\\{escaped[at:]}"
    return escape(escaped).replace("\0", "<!-- -->")


def latex(text: str) -> str:
    """For the text of a LaTeX document in UTF-8."""
    return one_line(text).translate(TEX)


def csv_text(text: str) -> str:
    """For a cell of a table that people open in a spreadsheet: what would be a formula begins with an apostrophe."""
    plain = one_line(text)
    return f"'{plain}" if plain.startswith(("=", "+", "-", "@")) else plain


def xml(text: str) -> str:
    """For an element or a quoted attribute of XML 1.0, which cannot hold control characters at all."""
    return escape(one_line(text), {'"': "&quot;", "'": "&apos;"})
