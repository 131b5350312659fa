"""How fast the runner is, against a floor and a peer, measured in one run on one machine."""
