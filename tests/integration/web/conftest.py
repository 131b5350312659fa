from tests.support.analysis_fixtures import small, study, tables
from tests.support.web_fixtures import browser, page
