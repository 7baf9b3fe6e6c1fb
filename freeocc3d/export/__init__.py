"""Writers of finished maps, one file per format; base.py is their contract."""
