// Square sheet, 1 m x 1 m, in the xy plane.
// Surface "sheet"; curves "left", "right", "bottom", "top"; points "corners", and each by itself:
// "corner1" (0, 0), "corner2" (1, 0), "corner3" (1, 1), "corner4" (0, 1).
SetFactory("Built-in");

side = 1.0;   // m
size = 0.04;  // m, length of an element's edge

Point(1) = {0, 0, 0, size};
Point(2) = {side, 0, 0, size};
Point(3) = {side, side, 0, size};
Point(4) = {0, side, 0, size};

Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};

Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};

Physical Surface("sheet") = {1};
Physical Curve("bottom") = {1};
Physical Curve("right") = {2};
Physical Curve("top") = {3};
Physical Curve("left") = {4};
Physical Point("corners") = {1, 2, 3, 4};
For i In {1:4}
  Physical Point(Sprintf("corner%g", i)) = {i};
EndFor
