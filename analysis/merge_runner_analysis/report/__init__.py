"""The report: what the results show, in words, on one HTML page with tables and figures."""
