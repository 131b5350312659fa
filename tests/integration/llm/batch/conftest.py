from tests.support.batch_fixtures import form, server, service_at, transport_to
