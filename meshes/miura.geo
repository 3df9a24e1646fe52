// Miura-ori, flat, of n x n cells of four parallelograms each, with sides a and b and acute angle gamma.
// Curves along x are straight, those across zigzag. As seen from above (along -z), valleys fold upwards:
// curves across are valleys and mountains in turn, and so are the parts of each straight curve.
n = DefineNumber[6, Name "cells along a side"];
a = DefineNumber[0.05, Name "side along x (m)"];
b = DefineNumber[0.05, Name "side across (m)"];
gamma = DefineNumber[60, Name "acute angle (degrees)"] * Pi / 180;
size = DefineNumber[0.0055, Name "mesh size (m)"];
m = 2 * n;

For j In {0:m}
  For i In {0:m}
    Point(1 + j * (m + 1) + i) = {i * a + (j % 2) * b * Cos(gamma), j * b * Sin(gamma), 0, size};
  EndFor
EndFor
straight = 1;                 // of point (i, j) to (i + 1, j): straight + j m + i
across = 1 + m * (m + 1);     // of point (i, j) to (i, j + 1): across + j (m + 1) + i
For j In {0:m}
  For i In {0:m-1}
    Line(straight + j * m + i) = {1 + j * (m + 1) + i, 2 + j * (m + 1) + i};
  EndFor
EndFor
For j In {0:m-1}
  For i In {0:m}
    Line(across + j * (m + 1) + i) = {1 + j * (m + 1) + i, 1 + (j + 1) * (m + 1) + i};
  EndFor
EndFor
valley_across[] = {};
mountain_across[] = {};
valley_straight[] = {};
mountain_straight[] = {};
For j In {0:m-1}
  For i In {0:m-1}
    Curve Loop(1 + j * m + i) = {straight + j * m + i, across + j * (m + 1) + i + 1,
      -(straight + (j + 1) * m + i), -(across + j * (m + 1) + i)};
    Plane Surface(1 + j * m + i) = {1 + j * m + i};
    If (i > 0)
      If (i % 2 == 0)
        valley_across[] += {across + j * (m + 1) + i};
      Else
        mountain_across[] += {across + j * (m + 1) + i};
      EndIf
    EndIf
    If (j > 0)
      If ((i + j) % 2 == 1)
        valley_straight[] += {straight + j * m + i};
      Else
        mountain_straight[] += {straight + j * m + i};
      EndIf
    EndIf
  EndFor
EndFor
Physical Curve("valley across") = {valley_across[]};
Physical Curve("mountain across") = {mountain_across[]};
Physical Curve("valley straight") = {valley_straight[]};
Physical Curve("mountain straight") = {mountain_straight[]};
Physical Surface("sheet") = {1:m*m};
