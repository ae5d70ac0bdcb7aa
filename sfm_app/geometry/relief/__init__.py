"""Relief that is stored in a texture."""
