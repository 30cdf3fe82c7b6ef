"""The long-running daemon: adapters wired to the rooms, one owner for each task."""
