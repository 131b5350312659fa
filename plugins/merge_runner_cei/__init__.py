"""Two drivers of human merging, a plug-in of merge-runner: ``cei`` and ``human-replay``.

``cei`` is the communication-enabled interaction model of Siebinga, Zgonnikov and Abbink, PNAS Nexus
3(10), pgae420 (2024), arXiv 2312.09776; re-implemented from its equations, with thresholds
calibrated to its published outcomes.
"""
