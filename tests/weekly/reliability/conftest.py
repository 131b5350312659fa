from tests.support.priced import priced
