"""A smooth psf field from stamps of point sources, of mosaics too."""
