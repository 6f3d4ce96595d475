# What something lacks of these fields, each with its type; a number is "count" if it is whole and not negative.
def is(type_name): if type_name == "count" then type == "number" and . >= 0 and . == floor else type == type_name end;
def lacks(types): . as $it | types | to_entries[] | .key as $type | .value | split(" ")[] | . as $name
  | select($it[$name] | is($type) | not) | "'\($name)' should be of type \($type) in \($it)";
def unmeasured: select(.n == 0) | "nothing was measured in \(.)";
def rows(types): if length == 0 then "there are no rows" else .[] | lacks(types), unmeasured end;
