from tests.engine.conftest import make, photos, start, views

__all__ = ["make", "photos", "start", "views"]
