"""The files of the page. File paths are never derived from requests."""

from __future__ import annotations

from typing import Final

_SCRIPT: Final = "text/javascript; charset=utf-8"
PAGE_FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/station.css": ("station.css", "text/css; charset=utf-8"),
    "/station.svg": ("station.svg", "image/svg+xml"),
    **{
        f"/{name}.js": (f"{name}.js", _SCRIPT)
        for name in (
            "theme",
            "station",
            "pictures",
            "enrol",
            "history",
            "settings",
            "profile",
            "drop",
            "commission",
        )
    },
}
"""Path of a request -> file of the package and its media type; they need no token."""
