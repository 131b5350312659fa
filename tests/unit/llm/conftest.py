from tests.support.clients import cache, make, opened
