"""A replacement for the module that `urllib.request` uses on macOS to find proxies. It finds none."""

from __future__ import annotations


def _get_proxy_settings() -> dict[str, object]:
    return {}


def _get_proxies() -> dict[str, str]:
    return {}
