from tests.support.analysis_fixtures import imported, small, study, tables
