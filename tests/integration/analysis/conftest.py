from tests.support.analysis_fixtures import in_process, small, study, tables
