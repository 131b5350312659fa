"""Recordings that are changed, as somebody who knows their format would."""

import duckdb


def quoted(text):
    return "'" + text.replace("'", "''") + "'"


def rewritten(file, *changes, select="FROM calls", **told):
    """The recording with its rows and metadata changed, as somebody who knows the format would."""
    bad = file.with_name("bad.parquet")
    with duckdb.connect() as connection:
        pairs = connection.execute(f"FROM parquet_kv_metadata('{file}')").fetchall()
        kept = {key.decode(): value.decode() for _, key, value in pairs} | told
        connection.execute(f"CREATE TABLE calls AS FROM '{file}'")
        for change in changes:
            connection.execute(change)
        listed = ", ".join(f"{name}: {quoted(value)}" for name, value in kept.items())
        connection.execute(
            f"COPY ({select}) TO {quoted(str(bad))} (FORMAT parquet, COMPRESSION zstd, "
            f"KV_METADATA {{{listed}}})"
        )
    return bad
