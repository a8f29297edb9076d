"""Whatever happens to a cache's folder, the cache misses and the run goes on."""

import shutil
from pathlib import Path

import pytest

from abcd_ns.engine.storage import LayerCache
from tests.engine.test_layer_cache import MIB, copy_while_open, key, layer, same


def test_a_folder_that_is_deleted_under_a_run_is_a_cache_that_misses(tmp_path):
    with LayerCache(tmp_path / "cache", MIB) as cache:
        cache.put(key(1), layer(1))
        shutil.rmtree(tmp_path / "cache")
        cache.put(key(2), layer(2))
        assert cache.get(key(3)) is None
        cache.clear()
        cache.put(key(4), layer(4))
        assert cache.get(key(4)) is None or not same(cache.get(key(4)), layer(5))
    assert not (tmp_path / "cache" / "unsynced").exists()


def test_no_cache_under_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="Not a directory"):
        LayerCache(tmp_path / "file" / "cache", MIB)


@pytest.mark.parametrize("name", ["data.mdb", "unsynced", "lock"])
@pytest.mark.parametrize("length", [0, 1, 4095, "half", "less one"])
def test_every_file_cut_short_anywhere_never_crashes(tmp_path, name, length):
    copy_while_open(tmp_path / "a", tmp_path / "b")
    path: Path = tmp_path / "b" / name
    whole = path.stat().st_size
    size = {"half": whole // 2, "less one": whole - 1}.get(length, length)
    with open(path, "r+b") as file:
        file.truncate(min(size, whole))
    with LayerCache(tmp_path / "b", MIB) as cache:
        found = [cache.get(key(i)) for i in range(20)]
        assert all(layer_ is None or same(layer_, reference(i)) for i, layer_ in enumerate(found))
        cache.put(key(3), layer(3))
        assert same(cache.get(key(3)), reference(3, 4))


def reference(seed: int, size: int = 20):
    """The layer as the codec gives it back."""
    with LayerCache(None, MIB) as cache:
        cache.put(key(seed), layer(seed, size))
        return cache.get(key(seed))
