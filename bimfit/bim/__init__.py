"""Building models: IFC in, joints and their designed sections, IFC out."""
