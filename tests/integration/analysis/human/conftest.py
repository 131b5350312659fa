from tests.support.human_fixtures import human
