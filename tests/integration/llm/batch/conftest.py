from tests.support.batch_fixtures import (
    _no_certificates,
    emulator,
    form,
    server,
    service_at,
    transport_to,
)
