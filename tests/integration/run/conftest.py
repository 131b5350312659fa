from tests.support.cluster import scheduler, started
