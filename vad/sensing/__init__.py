"""Packets to Doppler spectrogram and path length change. Pure: arrays in, values out."""
