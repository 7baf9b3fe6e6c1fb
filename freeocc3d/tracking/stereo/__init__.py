"""Multi-view stereo: dense depth of posed frames from their colour."""
