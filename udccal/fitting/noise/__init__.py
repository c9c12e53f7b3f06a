"""The noise fit after EMVA 1288, from dark frames and flats; ``fit.py`` has the entry."""
