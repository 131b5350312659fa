"""The explorer: pages in a browser on which a trial is watched and every decision read."""
