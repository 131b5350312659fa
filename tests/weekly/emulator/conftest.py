from tests.support.emulator_fixtures import driving_prompt, emulator
