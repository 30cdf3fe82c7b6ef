"""The home in Home Assistant, by way of an MQTT broker: what the bus publishes, as entities."""
