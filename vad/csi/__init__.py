"""CSI packets off the air: decoding, live sources, whose packet it is."""
