"""Pages of results: HTML that needs no other file, with tables and pictures."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2430; max-width: 1120px;
       margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.7em; margin-bottom: .1em; } h2 { font-size: 1.2em; margin-top: 2em;
     border-bottom: 1px solid #d5dae0; padding-bottom: .2em; }
table { border-collapse: collapse; margin: .8em 0; }
th, td { padding: .28em .9em .28em 0; text-align: left; border-bottom: 1px solid #e6e9ed;
         vertical-align: top; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
img { max-width: 100%; margin: 1.2em 0; }
@media (max-width: 700px) { body { margin-top: 1em; } table { display: block; overflow-x: auto; } }
"""
Row = Sequence[object]


def page(title: str, parts: Iterable[str]) -> str:
    """A page of parts that are HTML already, below a title that is not."""
    title = escape(title)
    head = "<!doctype html><html lang=en><head><meta charset=utf-8>"
    head += "<meta name=viewport content='width=device-width, initial-scale=1'>"
    start = f"{head}<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>"
    return "\n".join([start, *parts, "</body></html>\n"])


def table(rows: Iterable[Row]) -> str:
    """A table whose first row is its head."""
    lines = []
    for number, row in enumerate(rows):
        kind = "td" if number else "th"
        lines.append("".join(f"<{kind}>{escape(str(cell))}</{kind}>" for cell in row))
    return "<table><tr>" + "</tr>\n<tr>".join(lines) + "</tr></table>"


def image(kind: str, content: bytes, text: str) -> str:
    """A picture of a kind such as png, in the page itself, with a text in its place."""
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return f"<img src='{source}' alt='{escape(text, quote=True)}'>"
