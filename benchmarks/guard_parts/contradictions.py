"""What a finished page says twice in two ways, from its text alone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser

_NUMBER = r"(-?\d+(?:\s\d{3})*(?:\.\d+)?)"
_ENDS = {"p", "li", "td", "th", "figcaption", "h2", "h3", "dd", "dt"}
_NO_OBJECTION = re.compile("no check objected|there is no objection|no objections", re.IGNORECASE)


@dataclass
class _Reader(HTMLParser):
    """Texts of a page's elements as (section, tag, class, text), in order."""

    found: list[tuple[str, str, str, str]] = field(default_factory=list)
    section: str = ""
    _tag: str = ""
    _class: str = ""
    _text: str = ""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        if tag in ("section", "footer"):
            self.section = named.get("id") or self.section
        if tag in _ENDS:
            self._tag, self._class, self._text = tag, named.get("class") or "", ""

    def handle_endtag(self, tag: str) -> None:
        if tag in _ENDS:
            text = " ".join(self._text.split())
            self.found.append((self.section, tag, self._class, text))
            self._text = ""

    def handle_data(self, data: str) -> None:
        self._text += data


def contradictions(page: str) -> list[str]:
    """Return what a page contradicts itself in, a sentence each; [] for a page that does not.

    page : the text of a report. Found are numbers of one name and unit that differ by more than
    their rounding; "no objection" beside objections; advice to add what is there.
    """
    reader = _Reader()
    reader.feed(re.sub(r"<(script|style|svg)\b.*?</\1>", "", page, flags=re.DOTALL))
    said = [one for one in reader.found if one[0] != "terms"]
    return [*_numbers(said), *_objections(said), *_advice(said)]


def _numbers(said: list[tuple[str, str, str, str]]) -> Iterator[str]:
    """Compare every tile's number with those that other tiles and sentences give by its name."""
    texts = [text for _, _, _, text in said]
    tiles = [
        (texts[i], texts[i + 1])
        for i in range(len(said) - 1)
        if said[i][2] == "name" and said[i + 1][2] == "value"
    ]
    sentences = [text for _, _, kind, text in said if kind not in ("name", "value")]
    for name, value in dict.fromkeys(tiles):
        match = re.match(rf"{_NUMBER}(?: ± {_NUMBER})? ?(\S*)", value)
        if match is None:
            continue
        stated, unit = match[1], match[3]
        again = rf"\b{re.escape(name)}(?: of| is)? {_NUMBER}(?: ± {_NUMBER})? ?{re.escape(unit)}"
        others = [other[1] for text in sentences for other in re.finditer(again, text)]
        others += [
            found[1]
            for title, text in tiles
            if title == name and (found := re.match(rf"{_NUMBER}.*{re.escape(unit)}", text))
        ]
        for other in dict.fromkeys(others):
            if _differ(stated, other):
                yield f"{name} is {stated} {unit} and {other} {unit}"


def _differ(one: str, other: str) -> bool:
    """Return whether two numbers differ by more than the last digit of the coarser one."""
    plain = [re.sub(r"\s", "", text) for text in (one, other)]
    last = max(10.0 ** -len(text.partition(".")[2]) for text in plain)
    return abs(float(plain[0]) - float(plain[1])) > last


def _objections(said: list[tuple[str, str, str, str]]) -> Iterator[str]:
    against = [text for section, tag, _, text in said if section == "verdict" and tag == "li"]
    if against and any(_NO_OBJECTION.search(text) for _, _, _, text in said):
        yield f"there is no objection, and one is: {against[0]}"


def _advice(said: list[tuple[str, str, str, str]]) -> Iterator[str]:
    whole = " ".join(text for _, _, _, text in said)
    cells = [text for _, tag, _, text in said if tag in ("td", "th")]
    heads = {text for _, tag, _, text in said if tag in ("h2", "h3", "th")}
    if "under [fluid] in rig.toml" in whole and ({"Re", "Drag against Reynolds number"} & heads):
        yield "a liquid is to be described, and Reynolds numbers are there"
    if "fix a strip of dots to the tank" in whole and "Marks fixed to the tank" in heads:
        yield "marks are to be fixed to the tank, and marks were followed"
    arms = {text for text in cells if re.match(r"(accelerometer )?arm[_ ](?!of )", text)}
    if "mount one accelerometer on each camera arm" in whole and len(arms) > 1:
        yield f"accelerometers are to be mounted on arms that have some: {', '.join(sorted(arms))}"
