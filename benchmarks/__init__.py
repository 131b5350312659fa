"""Speed of the runner, against a floor and a peer, measured in one run on one machine."""
