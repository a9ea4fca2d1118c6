"""One hostile alphabet: what a name or a message may hold, against every format that it is written into."""

from html.parser import HTMLParser

HOSTILE = (
    "".join(map(chr, range(0x20, 0x7F))),
    "\x00\x07\x1b[31m\x85\u2028\ufffe tail",
    "a|b\n| c | d |\n\n# head\r\n- item",
    "<script>alert(1)</script> <b>&amp; &#60; ]]> <!-- -->",
    "![x](y) [a](javascript:b) `code` ``` *i* **b** _u_ __v__ ~~s~~ $x$ @someone #12 https://a.b www.a.b",
    r"\input{x} \\ {} $x^2$ 50% a&b #1 a_b ~ -- '' `` <<",
    *("=1+1", "+1", "-1+cmd|' /C calc'!A0", "@SUM(A1)", "\t=1+1", "  =1"),
    *("# head", "- item", "+ item", "1. item", "2) item", "===", "---", "***", "> quote", "-1.25", "```", "~~~"),
    "ünïcode 漢字 😀 ↑ ± τ",
)


class Text(HTMLParser):
    """What a browser shows of a page, and which tags it found."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text, self.tags = "", list[str]()
        self.feed(html)

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
