"""Whatever was done to a cache's folder, or is done meanwhile, the cache misses and the run goes on."""

import shutil

import pytest

from abcd_ns.engine.storage import LayerCache
from tests.reference.cache_file import ENTRIES, MIB, fill_cache, key, layer


def test_a_folder_that_is_deleted_under_a_run_is_a_cache_that_misses(tmp_path):
    with LayerCache(tmp_path / "run" / "cache", MIB) as cache:
        cache.put(key(1), layer(1))
        shutil.rmtree(tmp_path / "run")
        cache.put(key(2), layer(2))
        assert cache.get(key(3)) is None
        cache.clear()
        cache.put(key(4), layer(4))
        assert cache.get(key(4)) is None
        assert cache.rejected == 1
        (tmp_path / "run").mkdir()
        cache.put(key(5), layer(5))
        assert cache.get(key(5)) is not None


def test_no_cache_under_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="Not a directory"):
        LayerCache(tmp_path / "file" / "cache", MIB)


@pytest.mark.parametrize("name", ["data.mdb", "lock"])
@pytest.mark.parametrize("damage", ["gone", "empty", "1 byte", "header less 1", "half", "less 1", "flipped"])
def test_what_an_earlier_run_left_is_never_believed(tmp_path, name, damage):
    """LMDB would map it, and crash where its pages make no sense."""
    fill_cache(tmp_path)
    path = tmp_path / name
    whole = path.read_bytes()
    lengths = {"empty": 0, "1 byte": 1, "header less 1": 4095, "half": len(whole) // 2}
    content = whole[: lengths.get(damage, len(whole) - (damage == "less 1"))]
    if damage == "flipped":
        content = bytes(byte ^ 4 if i % 64 < 2 else byte for i, byte in enumerate(whole))
    path.unlink()
    if damage != "gone":
        path.write_bytes(content)
    with LayerCache(tmp_path, MIB) as cache:
        assert all(cache.get(key(index)) is None for index in range(ENTRIES))
        cache.put(key(3), layer(3))
        assert cache.get(key(3)) is not None
        assert cache.corrupt == cache.recreated == 0
