from tests.support.web_fixtures import browser, page
