"""A page judged as a browser's policy would: what runs in it, what it looks like, and what it loads."""

from __future__ import annotations

import base64
import hashlib
from html.parser import HTMLParser

_LOADS = ("src", "href", "srcset", "action", "data", "poster", "background", "xlink:href", "formaction")


class Page(HTMLParser):
    """What a page holds: ``text``, ``loads``, ``scripts``, ``styles`` and ``policy``, its first ``<meta>``."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.inline: list[str] = []
        self.text = ""
        self.policy = ""
        self.before_policy: list[str] = []
        self.scripts: list[str] = []
        self.styles: list[str] = []
        self._within = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values["content"] or ""
        elif not self.policy:
            self.before_policy.append(tag)
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in _LOADS]
        self.inline += [name for name, _ in attrs if name == "style" or name.startswith("on")]
        self._within = tag if tag == "style" or (tag == "script" and "type" not in values) else ""
        if self._within:
            (self.styles if tag == "style" else self.scripts).append("")

    def handle_endtag(self, tag: str) -> None:
        self._within = ""

    def handle_data(self, data: str) -> None:
        if self._within:
            (self.styles if self._within == "style" else self.scripts)[-1] += data
        else:
            self.text += data


def hashed(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def assert_strict(html: str) -> Page:
    """Assert that a page loads nothing and lets a browser run nothing but what it was written with."""
    page = Page(html)
    rules = {name: values for name, *values in (part.split() for part in page.policy.split(";"))}
    assert rules.pop("default-src") == ["'none'"]
    assert rules.pop("img-src") == ["data:"]
    assert rules.pop("base-uri") == rules.pop("form-action") == ["'none'"]
    assert rules.pop("script-src", []) == [hashed(script) for script in page.scripts]
    assert rules.pop("style-src") == [hashed(style) for style in page.styles]
    assert not rules
    # In force before anything else is read.
    assert page.before_policy == ["html", "head", "meta"]
    assert not page.inline, "the policy would leave these out"
    assert all(load.startswith(("#", "data:image/png;base64,")) for load in page.loads)
    assert not {"iframe", "object", "embed", "link", "base", "form", "video", "audio"} & set(page.tags)
    assert not [line for style in page.styles for line in ("@import", "url(") if line in style]
    return page
