"""Pages whose prose is written by hand, and their tables by scripts: between two comments."""

import re
from collections.abc import Iterable, Mapping, Sequence

BLOCK = re.compile(r"(<!-- begin: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str, blocks: Mapping[str, str]) -> str:
    """A page with what stands between `<!-- begin: NAME -->` and `<!-- end -->` written anew.

    Raises:
        ValueError: the page has no place for a block, or for another one.
    """
    places = [match[2] for match in BLOCK.finditer(page)]
    if sorted(places) != sorted(blocks):
        raise ValueError(f"the page has places for {places}, and there are {list(blocks)}")
    return BLOCK.sub(lambda match: f"{match[1]}\n{blocks[match[2]]}\n{match[3]}", page)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
