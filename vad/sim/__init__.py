"""The simulated home: robot, camera, radio and hostapd through their real interfaces."""
