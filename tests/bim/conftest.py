import sys
from pathlib import Path

import pytest

# helpers beside the tests, under the import mode that has no packages
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def session_cache(tmp_path_factory):
    """Models are tessellated once a session, and the user's own cache stays as it is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BIMFIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
