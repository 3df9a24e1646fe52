// Sphere of radius 0.1 m around the origin.
// Surface "balloon", closed.
SetFactory("OpenCASCADE");

radius = 0.1;   // m
size = 0.0036;  // m, length of an element's edge

Sphere(1) = {0, 0, 0, radius};
Physical Surface("balloon") = Boundary{ Volume{1}; };
Mesh.MeshSizeMin = size;
Mesh.MeshSizeMax = size;
