from tests.support.explorer_fixtures import browser, page
