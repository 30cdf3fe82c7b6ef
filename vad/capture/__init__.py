"""Who is measured when: the handshake, the session folder."""
