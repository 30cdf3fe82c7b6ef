"""The hub's own certificate authority: who may reach the bus from the network."""
