from tests.support.emulator_fixtures import driving_prompt, emulator
from tests.support.sdks import no_settings_of_the_user
