"""Peers train on the engine's small scene."""

from tests.engine.conftest import photos, start, views

__all__ = ["photos", "start", "views"]
