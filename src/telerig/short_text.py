"""Short texts of results, for a prompt and for a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

LONGEST = 160
"""Longest text of a fact in characters; the rest is cut."""


class ShortText:
    """Give an object a short `repr` and a small table in notebooks, both made of its facts.

    A dataclass that inherits from this class needs ``repr=False``.
    """

    def title(self) -> str:
        """Return the kind of the object, its name and its verdict, if it has them."""
        raise NotImplementedError

    def facts(self) -> Mapping[str, str]:
        """Return what a user wants to know first, by name; empty texts are left out."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = _shown(self.facts())
        width = max(map(len, facts), default=0)
        return "\n".join([self.title(), *(f"  {n:<{width}}  {text}" for n, text in facts.items())])

    def _repr_html_(self) -> str:
        cell = "<td style='text-align:left'>"
        rows = "".join(
            f"<tr>{cell}<b>{escape(name)}</b></td>{cell}{escape(text)}</td></tr>"
            for name, text in _shown(self.facts()).items()
        )
        return f"<div><b>{escape(self.title())}</b><table>{rows}</table></div>"


def _shown(facts: Mapping[str, str]) -> dict[str, str]:
    short = {name: " ".join(text.split()) for name, text in facts.items()}
    return {
        name: text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."
        for name, text in short.items()
        if text
    }


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, as in "1 frame" and "2 frames"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def first_of(sentences: tuple[str, ...] | list[str]) -> str:
    """Return the first sentence and how many more there are; "" for none."""
    more = f" (and {len(sentences) - 1} more)" if len(sentences) > 1 else ""
    return f"{sentences[0][: LONGEST - 20]}{more}" if sentences else ""
