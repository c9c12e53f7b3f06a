"""USB3 Vision cameras of any maker, on libusb and EMVA's GenApi, without a maker's SDK."""
