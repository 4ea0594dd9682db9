"""Hook of the site: what scrolls by itself can be reached by keyboard, and the footer is a landmark."""

from __future__ import annotations

from typing import Any

SCROLLED = ("<table", "<pre><code")


def on_page_content(html: str, **_: Any) -> str:
    """The page with its tables and listings as stops of the Tab key."""
    for tag in SCROLLED:
        html = html.replace(tag, f'{tag} tabindex="0"')
    return html


def on_post_page(output: str, **_: Any) -> str:
    """The page with the whole of its footer named as such to screen readers."""
    output = output.replace('<div role="contentinfo">', "<div>")
    return output.replace("<footer>", '<footer role="contentinfo">')
