from tests.support.disks import read_only, small_disk
from tests.support.priced import priced
