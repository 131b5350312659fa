"""The report: what the results show, in words, and the page that shows it."""
