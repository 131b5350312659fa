"""The numbers of more databases stay what they are."""

import pytest

from tests.support.frozen import MORE_DATABASES, check


@pytest.mark.parametrize("name", MORE_DATABASES)
def test_every_number_of_every_table_is_what_it_was(name, tmp_path):
    check(name, tmp_path)
