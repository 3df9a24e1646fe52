// Flat box cushion, 0.4 m x 0.4 m x 0.03 m, standing on the xy plane and centred on the z axis.
// Surface "cushion", closed.
SetFactory("OpenCASCADE");

width = 0.4;    // m
height = 0.03;  // m
size = 0.0065;  // m, length of an element's edge

Box(1) = {-width / 2, -width / 2, 0.005, width, width, height};
Physical Surface("cushion") = Boundary{ Volume{1}; };
Mesh.MeshSizeMin = size;
Mesh.MeshSizeMax = size;
