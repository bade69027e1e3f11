% Centroid and peak contrast of the stacks of a challenge, in Octave, without this package:
%
%     iscat challenge make --preset easy --out easy
%     octave-cli benchmarks/challenge.m easy 10 84.4 octave.csv
%     iscat challenge score easy octave.csv --out scores
%
% The arguments are the folder, the frames before the particle, and the pixel size in nm; both stand
% in manifest.json.

arguments = argv();
folder = arguments{1};
before = str2double(arguments{2});
pixel = str2double(arguments{3});
files = dir(fullfile(folder, "stacks", "*.tif"));
out = fopen(arguments{4}, "w");
fprintf(out, "file,x_px,y_px,contrast\n");
for k = 1:numel(files)
  frames = double(squeeze(imread(fullfile(folder, "stacks", files(k).name), "Index", "all")));
  contrast = mean(frames(:, :, before+1:end), 3) ./ mean(frames(:, :, 1:before), 3) - 1;
  [rows, columns] = size(contrast);
  [x, y] = meshgrid(0:columns-1, 0:rows-1);
  smooth = conv2(contrast, ones(3) / 9, "same");
  near = hypot(x - (columns - 1) / 2, y - (rows - 1) / 2) <= 3;
  candidate = smooth .* near;
  [~, place] = max(abs(candidate(:)));
  polarity = sign(candidate(place));
  row = y(place);
  column = x(place);
  for pass = 1:10
    disc = hypot(x - column, y - row) <= 2.5;
    weight = max(polarity * contrast, 0) .* disc;
    column = sum(sum(weight .* x)) / sum(weight(:));
    row = sum(sum(weight .* y)) / sum(weight(:));
  end
  amplitude = sum(contrast(disc)) / sum(disc(:));
  fprintf(out, "%s,%.6f,%.6f,%.6e\n", files(k).name, column, row, amplitude);
end
fclose(out);
