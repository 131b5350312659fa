from tests.support.explorer_fixtures import (
    browser,
    page,
    pytest_collection_modifyitems,
    pytest_runtest_setup,
    site,
    study,
)
