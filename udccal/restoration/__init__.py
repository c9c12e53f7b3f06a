"""The runtime that undoes the panel: raw mosaics in, clean pictures out."""
