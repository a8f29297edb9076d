import pytest

from abcd_ns.engine.store import ParameterStore
from tests.reference.store_helpers import block


@pytest.fixture
def store(tmp_path):
    """Two blocks, one of them empty."""
    with ParameterStore.create(tmp_path / "store", {"tree": [1, 2]}) as store:
        store.commit({0: block(3, 1.0), 7: block(0, 2.0)}, state={"clock": 5})
        yield store
