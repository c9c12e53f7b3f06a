"""A smooth psf field from stamps of point sources; mosaics are allowed."""
