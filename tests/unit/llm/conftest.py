from tests.support.clients import cache, make, opened
from tests.support.virtual_time import virtual_time
